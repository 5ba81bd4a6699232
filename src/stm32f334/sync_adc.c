/* The fast ADC: HRTIM's trigger ─► ADC1 ─► DMA channel 1 ─► two halves of a buffer, for ever round.
 *
 * Samples are counted by the clock: HRTIM, TIM2 and ADC run from one PLL, so sample n is at start + n * period for ever, and
 * how many have been taken follows from the time alone, exactly also between a sample's instant and its arrival in
 * memory.  `base` moves on with each half buffer, to keep differences of the 32-bit clock short.
 *
 * Nothing of this can lose a sample silently: an overrun stops the ADC and shuts down; a late interrupt is noticed by
 * whoever compares position with what it was given; samples that stop coming altogether (no trigger, no DMA) are found by
 * sync_adc_objection(), which is asked at every change of phase.
 */
#include "board/bridge_pwm.h"
#include "board/irq.h"
#include "board/sync_adc.h"
#include "board/timer.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

enum {
    CHANNEL = 1,
    HALF_LEN_MAX = PORT_SYNC_HALF_LEN,
    SAMPLING_1_5 = 0,           /* SMPR: 1.5 cycles */
    TRIGGER_HRTIM_1 = 7,        /* EXTSEL (RM0364) */
    RISING = 1,
    EDGE_CLEAR_TICKS = 150,     /* sync_adc_start() keeps so far from period edges */
    HALVES_LATE_MAX = 2,
    SPIN_LIMIT = 20000,
};
#define DMA DMA_CHANNEL(CHANNEL)

static struct {
    uint16_t buffer[2 * HALF_LEN_MAX];
    uint16_t half_len;          /* 0: not set up */
    uint8_t running;
    sync_adc_ready_fn ready;
    uint32_t period_ticks;
    uint32_t base_clock, base_index; /* of the first sample of the half being filled */
    uint32_t half_ticks;
} sync;

void samples_irq(void);
void adc_irq(void);

void
sync_adc_init(void)
{
    sync.half_len = 0;
    sync.running = 0;
}
DECL_INIT(sync_adc_init);

/* DS9994. */
static uint8_t
channel_of(uint32_t pin)
{
    static const struct { uint8_t pin, channel; } inputs[] = {
        { PIN_A + 0, 1 }, { PIN_A + 1, 2 }, { PIN_C + 0, 6 }, { PIN_C + 1, 7 }, { PIN_C + 2, 8 }, { PIN_C + 3, 9 },
        { PIN_B + 0, 11 }, { PIN_B + 1, 12 }, { PIN_B + 13, 13 },
    };
    for (unsigned i = 0; i < sizeof(inputs) / sizeof(inputs[0]); i++)
        if (inputs[i].pin == pin)
            return inputs[i].channel;
    return 0;
}

static uint32_t
trigger_word(void)
{
    return ADC_CFGR_DMAEN | ADC_CFGR_DMACFG | ADC_CFGR_EXTSEL(TRIGGER_HRTIM_1) | ADC_CFGR_EXTEN(RISING);
}

static const uint32_t dma_word = DMA_CCR_TCIE | DMA_CCR_HTIE | DMA_CCR_TEIE | DMA_CCR_CIRC | DMA_CCR_MINC |
                                 DMA_CCR_PSIZE(1) | DMA_CCR_MSIZE(1) | DMA_CCR_PL(3);

struct sync_adc
sync_adc_setup(uint32_t pin, struct bridge_pwm b, uint16_t half_len, sync_adc_ready_fn ready)
{
    (void)b;
    uint8_t channel = channel_of(pin);
    if (!channel)
        shutdown(SHUTDOWN_NOT_ADC_PIN);
    sync.period_ticks = bridge_period_ticks();
    if (!sync.period_ticks || !half_len || half_len > HALF_LEN_MAX)
        shutdown(SHUTDOWN_SYNC_ADC);
    if (!adc_bring_up(ADC1_BASE))
        shutdown(SHUTDOWN_BRIDGE_ADC);
    pin_set_pull(pin, 0);
    pin_set_mode(pin, PIN_ANALOG);
    adc_set_channel(ADC1_BASE, channel, SAMPLING_1_5);
    ADC_CFGR(ADC1_BASE) = trigger_word();
    ADC_IER(ADC1_BASE) = ADC_IER_OVRIE;
    sync.half_len = half_len;
    sync.half_ticks = half_len * sync.period_ticks;
    sync.ready = ready;
    irq_allow(IRQ_DMA1_CHANNEL1);
    irq_allow(IRQ_ADC1_2);
    return (struct sync_adc){ 0 };
}

static void
stop(void)
{
    if (ADC_CR(ADC1_BASE) & ADC_CR_ADSTART)
        ADC_CR(ADC1_BASE) |= ADC_CR_ADSTP;
    for (unsigned spin = 0; spin < SPIN_LIMIT && ADC_CR(ADC1_BASE) & ADC_CR_ADSTP; spin++)
        ;
    DMA_CCR(DMA) = 0;
    DMA1_IFCR = DMA1_ISR_TCIF(CHANNEL) | DMA1_ISR_HTIF(CHANNEL) | DMA1_ISR_TEIF(CHANNEL);
    sync.running = 0;
}

/* Interrupts may come between, but not between reading the two counters. */
uint32_t
sync_adc_start(struct sync_adc a)
{
    (void)a;
    if (sync.running)
        stop();
    DMA_CPAR(DMA) = (uint32_t)(uintptr_t)&ADC_DR(ADC1_BASE);
    DMA_CMAR(DMA) = (uint32_t)(uintptr_t)sync.buffer;
    DMA_CNDTR(DMA) = 2u * sync.half_len;
    DMA_CCR(DMA) = dma_word | DMA_CCR_EN;
    ADC_ISR(ADC1_BASE) = ADC_ISR_OVR;
    irqstatus_t flag = irq_save();
    for (unsigned spin = 0; spin < SPIN_LIMIT; spin++) {
        uint32_t left = bridge_ticks_to_edge();
        if (left > EDGE_CLEAR_TICKS && left < sync.period_ticks - EDGE_CLEAR_TICKS / 2)
            break;
    }
    ADC_CR(ADC1_BASE) |= ADC_CR_ADSTART;
    sync.base_clock = bridge_next_edge();
    sync.base_index = 0;
    sync.running = 1;
    irq_restore(flag);
    return sync.base_clock;
}

static uint32_t
position_now(uint32_t now)
{
    int32_t since = (int32_t)(now - sync.base_clock);
    return since < 0 ? sync.base_index : sync.base_index + (uint32_t)since / sync.period_ticks + 1;
}

uint32_t
sync_adc_position(struct sync_adc a)
{
    (void)a;
    if (!sync.running)
        return 0;
    uint32_t position, base;
    do { /* again if samples_irq() came between */
        base = *(volatile uint32_t *)&sync.base_index;
        position = position_now(timer_read_time());
    } while (base != *(volatile uint32_t *)&sync.base_index);
    return position;
}

void
sync_adc_move(struct sync_adc a, uint16_t ticks)
{
    (void)a;
    bridge_move_sampling(ticks);
}

enum shutdown_reason
sync_adc_objection(void)
{
    if (!adc_is_up(ADC1_BASE) || ADC_CFGR(ADC1_BASE) != trigger_word() || !sync.running ||
        !(ADC_CR(ADC1_BASE) & ADC_CR_ADSTART) || DMA_CCR(DMA) != (dma_word | DMA_CCR_EN))
        return SHUTDOWN_BRIDGE_ADC;
    if ((int32_t)(timer_read_time() - sync.base_clock) > (int32_t)(HALVES_LATE_MAX * sync.half_ticks))
        return SHUTDOWN_SAMPLES_STOPPED;
    return SHUTDOWN_NONE;
}

/****************************************************************
 * Interrupts
 ****************************************************************/

static void
give_half(void *samples)
{
    sync.ready(samples, sync.half_len);
}

static void
report_stopped(void *unused)
{
    (void)unused;
    try_shutdown(SHUTDOWN_SAMPLES_STOPPED);
}

static void
next_half(void)
{
    sync.base_clock += sync.half_ticks;
    sync.base_index += sync.half_len;
}

void
samples_irq(void)
{
    const uint32_t half = DMA1_ISR_HTIF(CHANNEL), whole = DMA1_ISR_TCIF(CHANNEL), error = DMA1_ISR_TEIF(CHANNEL);
    uint32_t arrived = DMA1_ISR & (half | whole | error);
    DMA1_IFCR = arrived;
    if (!sync.running || !arrived)
        return;
    uint16_t *first = sync.buffer, *second = sync.buffer + sync.half_len;
    next_half();
    if (arrived == half) {
        sched_guarded(give_half, first);
    } else if (arrived == whole) {
        sched_guarded(give_half, second);
    } else if (arrived & error) {
        sched_guarded(report_stopped, 0);
    } else { /* both: this interrupt comes late, by one half or more; the older one first */
        uint32_t now = timer_read_time() + sync.period_ticks;
        while ((int32_t)(now - sync.base_clock) >= (int32_t)sync.half_ticks)
            next_half();
        uint8_t filling_first = DMA_CNDTR(DMA) > sync.half_len;
        sched_guarded(give_half, filling_first ? first : second);
        sched_guarded(give_half, filling_first ? second : first);
    }
}

/* The DMA has not fetched a sample before the next one: its requests stop, and samples would no longer be where they belong. */
void
adc_irq(void)
{
    ADC_ISR(ADC1_BASE) = ADC_ISR_OVR;
    stop();
    bridge_pwm_off((struct bridge_pwm){ 0 });
    sched_guarded(report_stopped, 0);
}
