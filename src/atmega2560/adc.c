/* Slow analog inputs: sixteen channels, PF0..PF7 and PK0..PK7, against AVCC.  Ten bits at 125 kHz, 13 clocks each. */
#include "board/adc.h"
#include "board/irq.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_CONSTANT("ADC_MAX", 1023);

enum {
    CHANNEL_NONE = 0xff,
    PRESCALER = 7,                    /* 128: 125 kHz; full resolution wants 50 to 200 (datasheet 26.4) */
    CONVERSION_TICKS = 13 * 128 + 64,
    FIRST_TICKS = 25 * 128 + 64,      /* the first one sets up the analog part */
};

static uint8_t busy_with;             /* channel, or CHANNEL_NONE */
static uint8_t warm;                  /* a conversion has been made */

void
adc_init(void)
{
    busy_with = CHANNEL_NONE;
    warm = 0;
    ADCSRA = 1 << ADEN | PRESCALER;
}
DECL_INIT(adc_init);

struct adc_in
adc_setup(uint32_t pin)
{
    uint8_t channel = pin >= PIN(PORT_K, 0) ? (uint8_t)(pin - PIN(PORT_K, 0) + 8) : (uint8_t)(pin - PIN(PORT_F, 0));
    if (pin < PIN(PORT_F, 0) || channel > 15 || (pin >= PIN(PORT_G, 0) && pin < PIN(PORT_K, 0)))
        shutdown(SHUTDOWN_NOT_ADC_PIN);
    irqstatus_t flag = irq_save();
    volatile uint8_t *off = channel < 8 ? &DIDR0 : &DIDR2;  /* its digital input would only draw current */
    *off |= (uint8_t)(1 << (channel & 7));
    irq_restore(flag);
    return (struct adc_in){ channel };
}

static void
start(uint8_t channel)
{
    busy_with = channel;
    ADMUX = (uint8_t)(1 << REFS0 | (channel & 7));
    ADCSRB = channel < 8 ? 0 : 1 << MUX5;
    ADCSRA |= 1 << ADSC;
}

uint32_t
adc_poll(struct adc_in a)
{
    uint32_t wait = CONVERSION_TICKS;
    irqstatus_t flag = irq_save();
    if (busy_with == a.channel) {
        wait = ADCSRA & 1 << ADSC ? CONVERSION_TICKS / 8 : 0;
    } else if (busy_with == CHANNEL_NONE && !(ADCSRA & 1 << ADSC)) {
        start(a.channel);
        if (!warm)
            wait = FIRST_TICKS;
    }
    irq_restore(flag);
    return wait;
}

uint16_t
adc_take(struct adc_in a)
{
    (void)a;
    busy_with = CHANNEL_NONE;
    warm = 1;
    return ADC;
}

/* A conversion cannot be stopped; adc_poll() waits for its end before the next begins. */
void
adc_cancel(struct adc_in a)
{
    irqstatus_t flag = irq_save();
    if (busy_with == a.channel)
        busy_with = CHANNEL_NONE;
    irq_restore(flag);
}
