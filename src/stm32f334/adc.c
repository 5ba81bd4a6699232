/* Bringing up a converter, and the slow inputs, one conversion at a time by software: the pins of ADC2, and the chip's own
 * temperature sensor.
 *
 * The two converters share one clock, HCLK undivided and in step with the timers: that is what makes the bridge's
 * sampling instant exact (docs/reference/STM32F334.md).  181.5 + 12.5 cycles of it are 2.7 us a slow conversion; the sensor wants 2.2 us
 * of sampling (DS9994), which are 159 cycles.
 *
 * The sensor is wired to ADC1 alone, whose regular conversions are the bridge's samples: it is an injected conversion of ADC1.  Begun
 * during a sample it would abort it, begun too late delay the next, so it begins in the gap (of 35 ticks at the shortest period):
 *
 *     edge                                                                          edge
 *      |__====_________|           gap           |____________________________________|__====____
 *        sample    AFTER_EDGE               BEFORE_EDGE: the sensor's conversion fits in      sample
 */
#include "board/adc.h"
#include "board/delay.h"
#include "board/irq.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_CONSTANT("ADC_MAX", 4095);
DECL_ENUMERATION("pin", "ADC_TEMPERATURE", 254);

enum {
    SPIN_LIMIT = 20000,
    REGULATOR_US = 10,          /* DS9994: start-up of the ADC's voltage regulator */
    SAMPLING_181 = 6,           /* SMPR: 181.5 cycles; DS9994: enough for 20 kOhm at least */
    CONVERSION_TICKS = 194, NOBODY = 0,
    PIN_TEMPERATURE = 254, SENSOR = 16, /* V_TS: channel 16 of ADC1 (RM0364; ADC2 has none of that number) */
    AFTER_EDGE_TICKS = 37,      /* trigger at 2 or 9, latency, 14 cycles of conversion */
    BEFORE_EDGE_TICKS = CONVERSION_TICKS + 34, /* latency; from reading the bridge's counter to the start */
    GAP_SPINS = 100,            /* at 8 cycles at least: more than there are from one gap to the next */
};
/* The sensor's start-up, 10 us, is over long before a converter has been calibrated. */
static const uint32_t common_word = ADC12_CCR_CKMODE(1) | ADC12_CCR_TSEN;

static struct {
    uint8_t channel;            /* being converted or waiting to be taken; NOBODY: none */
} slow;

void
adc_init(void)
{
    slow.channel = NOBODY;
}
DECL_INIT(adc_init);

static uint8_t
wait_for(volatile uint32_t *reg, uint32_t mask, uint32_t value)
{
    for (uint32_t spin = 0; spin < SPIN_LIMIT; spin++)
        if ((*reg & mask) == value)
            return 1;
    return 0;
}

uint8_t
adc_is_up(uint32_t adc)
{
    return RCC_AHBENR & RCC_AHBENR_ADC12EN && ADC12_CCR == common_word &&
           (ADC_CR(adc) & (ADC_CR_ADCAL | ADC_CR_ADVREGEN(3) | ADC_CR_ADEN)) == (ADC_CR_ADVREGEN(1) | ADC_CR_ADEN);
}

/* RM0364: regulator, 10 us, calibration, four cycles, on. */
uint8_t
adc_bring_up(uint32_t adc)
{
    RCC_AHBENR |= RCC_AHBENR_ADC12EN;
    if (!(RCC_AHBENR & RCC_AHBENR_ADC12EN))
        return 0;
    if (adc_is_up(adc))
        return 1;
    if (ADC12_CCR != common_word)
        ADC12_CCR = common_word;
    ADC_CR(adc) = ADC_CR_ADVREGEN(0);
    ADC_CR(adc) = ADC_CR_ADVREGEN(1);
    delay_ticks(timer_from_us(REGULATOR_US) + 1);
    ADC_CR(adc) = ADC_CR_ADVREGEN(1) | ADC_CR_ADCAL;
    /* It takes 112 cycles; one that is over at once has not been done. */
    if (!(ADC_CR(adc) & ADC_CR_ADCAL) || !wait_for(&ADC_CR(adc), ADC_CR_ADCAL, 0))
        return 0;
    delay_ticks(8);
    ADC_CR(adc) = ADC_CR_ADVREGEN(1) | ADC_CR_ADEN;
    return wait_for(&ADC_ISR(adc), ADC_ISR_ADRDY, ADC_ISR_ADRDY) && adc_is_up(adc);
}

static void
set_sampling(uint32_t adc, uint8_t channel, uint8_t sampling)
{
    volatile uint32_t *times = channel < 10 ? &ADC_SMPR1(adc) : &ADC_SMPR2(adc);
    uint8_t shift = 3 * (channel % 10);
    *times = (*times & ~(7u << shift)) | (uint32_t)sampling << shift;
}

void
adc_set_channel(uint32_t adc, uint8_t channel, uint8_t sampling)
{
    set_sampling(adc, channel, sampling);
    ADC_SQR1(adc) = ADC_SQR1_SQ1(channel);
}

/* DS9994. */
static uint8_t
channel_of(uint32_t pin)
{
    static const struct { uint8_t pin, channel; } inputs[] = {
        { PIN_A + 4, 1 }, { PIN_A + 5, 2 }, { PIN_A + 6, 3 }, { PIN_A + 7, 4 }, { PIN_C + 4, 5 }, { PIN_C + 0, 6 },
        { PIN_C + 1, 7 }, { PIN_C + 2, 8 }, { PIN_C + 3, 9 }, { PIN_C + 5, 11 }, { PIN_B + 2, 12 }, { PIN_B + 12, 13 },
        { PIN_B + 14, 14 }, { PIN_B + 15, 15 },
    };
    for (unsigned i = 0; i < sizeof(inputs) / sizeof(inputs[0]); i++)
        if (inputs[i].pin == pin)
            return inputs[i].channel;
    return NOBODY;
}

static struct adc_in
set_up_sensor(void)
{
    if (!adc_bring_up(ADC1_BASE))
        shutdown(SHUTDOWN_ADC_START);
    set_sampling(ADC1_BASE, SENSOR, SAMPLING_181);
    ADC_JSQR(ADC1_BASE) = ADC_JSQR_JSQ1(SENSOR);
    return (struct adc_in){ SENSOR };
}

struct adc_in
adc_setup(uint32_t pin)
{
    if (pin == PIN_TEMPERATURE)
        return set_up_sensor();
    uint8_t channel = channel_of(pin);
    if (!channel)
        shutdown(SHUTDOWN_NOT_ADC_PIN);
    if (!adc_bring_up(ADC2_BASE))
        shutdown(SHUTDOWN_ADC_START);
    pin_set_pull(pin, 0);
    pin_set_mode(pin, PIN_ANALOG);
    return (struct adc_in){ channel };
}

/* Waits for the gap, 4 us at most; asked again from another interrupt, it might be missed for ever.  A bridge whose counter stands
 * still triggers no samples.  Writing 0 to ADSTART and its like does nothing. */
static void
start_sensor(void)
{
    uint32_t period = bridge_period_ticks(), gap = period - AFTER_EDGE_TICKS - BEFORE_EDGE_TICKS;
    for (unsigned spin = 0; period && spin < GAP_SPINS; spin++)
        if (bridge_ticks_to_edge() - BEFORE_EDGE_TICKS <= gap)
            break;
    ADC_CR(ADC1_BASE) = ADC_CR_ADVREGEN(1) | ADC_CR_JADSTART;
}

static uint8_t
is_done(struct adc_in a)
{
    return a.channel == SENSOR ? (ADC_ISR(ADC1_BASE) & ADC_ISR_JEOC) != 0 : (ADC_ISR(ADC2_BASE) & ADC_ISR_EOC) != 0;
}

static uint16_t
result(struct adc_in a)
{
    return (uint16_t)(a.channel == SENSOR ? ADC_JDR1(ADC1_BASE) : ADC_DR(ADC2_BASE)); /* reading clears JEOC or EOC */
}

/* Timers and interrupts do not preempt each other, so a timer needs no lock here. */
uint32_t
adc_poll(struct adc_in a)
{
    if (slow.channel == a.channel)
        return is_done(a) ? 0 : CONVERSION_TICKS / 2;
    if (slow.channel != NOBODY)
        return CONVERSION_TICKS;
    slow.channel = a.channel;
    if (a.channel == SENSOR) {
        start_sensor();
    } else {
        adc_set_channel(ADC2_BASE, a.channel, SAMPLING_181);
        ADC_CR(ADC2_BASE) |= ADC_CR_ADSTART;
    }
    return CONVERSION_TICKS;
}

uint16_t
adc_take(struct adc_in a)
{
    slow.channel = NOBODY;
    return result(a);
}

void
adc_cancel(struct adc_in a)
{
    irqstatus_t flag = irq_save();
    unsigned spin = 0;
    if (slow.channel == a.channel) {
        while (!is_done(a) && spin++ < SPIN_LIMIT)
            ; /* 2.7 us at most */
        (void)result(a);
        slow.channel = NOBODY;
    }
    irq_restore(flag);
}
