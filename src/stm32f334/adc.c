/* Bringing up a converter, and the slow inputs: ADC2, one conversion at a time by software.
 *
 * The two converters share one clock, HCLK undivided and in step with the timers: that is what makes the bridge's
 * sampling instant exact (docs/STM32F334.md).  181.5 + 12.5 cycles of it are 2.7 us a slow conversion.
 */
#include "board/adc.h"
#include "board/delay.h"
#include "board/irq.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_CONSTANT("ADC_MAX", 4095);

enum {
    SPIN_LIMIT = 20000,
    REGULATOR_US = 10,          /* DS9994: start-up of the ADC's voltage regulator */
    SAMPLING_181 = 6,           /* SMPR: 181.5 cycles; DS9994: enough for 20 kOhm at least */
    CONVERSION_TICKS = 194, NOBODY = 0,
};

static struct {
    uint8_t up;
    uint8_t channel;            /* being converted or waiting to be taken; NOBODY: the converter is free */
} slow;

void
adc_init(void)
{
    slow.up = 0;
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
    return RCC_AHBENR & RCC_AHBENR_ADC12EN && ADC12_CCR == ADC12_CCR_CKMODE(1) &&
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
    if (ADC12_CCR != ADC12_CCR_CKMODE(1))
        ADC12_CCR = ADC12_CCR_CKMODE(1);
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

void
adc_set_channel(uint32_t adc, uint8_t channel, uint8_t sampling)
{
    volatile uint32_t *times = channel < 10 ? &ADC_SMPR1(adc) : &ADC_SMPR2(adc);
    *times = (uint32_t)sampling << 3 * (channel % 10);
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

struct adc_in
adc_setup(uint32_t pin)
{
    uint8_t channel = channel_of(pin);
    if (!channel)
        shutdown(SHUTDOWN_NOT_ADC_PIN);
    if (!slow.up && !adc_bring_up(ADC2_BASE))
        shutdown(SHUTDOWN_ADC_START);
    slow.up = 1;
    pin_set_pull(pin, 0);
    pin_set_mode(pin, PIN_ANALOG);
    return (struct adc_in){ channel };
}

/* Timers and interrupts do not preempt each other, so a timer needs no lock here. */
uint32_t
adc_poll(struct adc_in a)
{
    if (slow.channel == a.channel)
        return ADC_ISR(ADC2_BASE) & ADC_ISR_EOC ? 0 : CONVERSION_TICKS / 2;
    if (slow.channel != NOBODY)
        return CONVERSION_TICKS;
    slow.channel = a.channel;
    adc_set_channel(ADC2_BASE, a.channel, SAMPLING_181);
    ADC_CR(ADC2_BASE) |= ADC_CR_ADSTART;
    return CONVERSION_TICKS;
}

uint16_t
adc_take(struct adc_in a)
{
    (void)a;
    slow.channel = NOBODY;
    return (uint16_t)ADC_DR(ADC2_BASE); /* reading clears EOC */
}

void
adc_cancel(struct adc_in a)
{
    irqstatus_t flag = irq_save();
    if (slow.channel == a.channel) {
        if (ADC_CR(ADC2_BASE) & ADC_CR_ADSTART)
            ADC_CR(ADC2_BASE) |= ADC_CR_ADSTP;
        wait_for(&ADC_CR(ADC2_BASE), ADC_CR_ADSTART | ADC_CR_ADSTP, 0);
        (void)ADC_DR(ADC2_BASE);
        slow.channel = NOBODY;
    }
    irq_restore(flag);
}
