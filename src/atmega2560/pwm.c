/* Hardware PWM: Timers 0 to 4, phase correct with eight bits, so that 0 is off and 255 is on without pulses and a new value
 * comes into force between two pulses.  One period is 510 counts; the prescaler makes it 31 us to 33 ms.  The channels of
 * a timer share it: a second one must ask for the same period.  Timer5 is the clock.
 */
#include "board/gpio.h"
#include "board/irq.h"
#include "board/pwm.h"
#include "command.h"
#include "flash_data.h"
#include "internal.h"
#include "sched.h"

DECL_CONSTANT("PWM_MAX", 255);

enum { COUNTS = 510, PHASE_CORRECT_8 = 1, ENGAGED = 2 /* COMnx1: the timer drives the pin, high at the beginning */ };

struct channel {
    uint8_t pin;
    uint8_t com_shift;            /* of COMnx in TCCRnA */
    volatile uint8_t *control;    /* TCCRnA; TCCRnB follows */
    volatile uint8_t *compare;
    uint8_t wide;                 /* 16-bit register */
};

enum { COM_A = 6, COM_B = 4, COM_C = 2 };

static const struct channel channels[] FLASH_DATA = {
    { PIN(PORT_B, 7), COM_A, &TCCR0A, &OCR0A, 0 },
    { PIN(PORT_G, 5), COM_B, &TCCR0A, &OCR0B, 0 },
    { PIN(PORT_B, 5), COM_A, &TCCR1A, &OCR1AL, 1 },
    { PIN(PORT_B, 6), COM_B, &TCCR1A, &OCR1BL, 1 },
    { PIN(PORT_B, 4), COM_A, &TCCR2A, &OCR2A, 0 },
    { PIN(PORT_H, 6), COM_B, &TCCR2A, &OCR2B, 0 },
    { PIN(PORT_E, 3), COM_A, &TCCR3A, &OCR3AL, 1 },
    { PIN(PORT_E, 4), COM_B, &TCCR3A, &OCR3BL, 1 },
    { PIN(PORT_E, 5), COM_C, &TCCR3A, &OCR3CL, 1 },
    { PIN(PORT_H, 3), COM_A, &TCCR4A, &OCR4AL, 1 },
    { PIN(PORT_H, 4), COM_B, &TCCR4A, &OCR4BL, 1 },
    { PIN(PORT_H, 5), COM_C, &TCCR4A, &OCR4CL, 1 },
};

/* Clock select value i + 1 divides by 1 << shifts[i]; Timer2 has more of them. */
static const uint8_t shifts[] FLASH_DATA = { 0, 3, 6, 8, 10 };
static const uint8_t shifts_timer2[] FLASH_DATA = { 0, 3, 5, 6, 7, 8, 10 };

static uint8_t
nearest_clock(uint32_t cycle_ticks, const uint8_t *shift, uint8_t count)
{
    for (uint8_t i = 0; i + 1 < count; i++) {
        uint32_t this = (uint32_t)COUNTS << flash_byte(shift + i), next = (uint32_t)COUNTS << flash_byte(shift + i + 1);
        if (cycle_ticks < (this + next) / 2)
            return i + 1;
    }
    return count;
}

static struct channel
find_channel(uint32_t pin)
{
    struct channel c;
    for (uint8_t i = 0; i < sizeof(channels) / sizeof(channels[0]); i++) {
        flash_copy(&c, &channels[i], sizeof(c));
        if (c.pin == pin)
            return c;
    }
    shutdown(SHUTDOWN_NOT_PWM_PIN);
}

struct pwm_out
pwm_setup(uint32_t pin, uint32_t cycle_ticks, uint32_t value)
{
    const struct channel c = find_channel(pin);
    struct pwm_out p = { c.compare, c.wide };
    volatile uint8_t *control = c.control;
    uint8_t is_timer2 = control == &TCCR2A;
    uint8_t clock = nearest_clock(cycle_ticks, is_timer2 ? shifts_timer2 : shifts,
                                  is_timer2 ? sizeof(shifts_timer2) : sizeof(shifts));
    if (control[1] && control[1] != clock)
        shutdown(SHUTDOWN_PWM_CYCLE);
    pwm_write(p, value);
    irqstatus_t flag = irq_save();
    control[0] |= (uint8_t)(PHASE_CORRECT_8 | ENGAGED << c.com_shift);
    control[1] = clock;
    irq_restore(flag);
    gpio_out_setup(pin, 0);
    return p;
}

/* A 16-bit register takes its high byte from a buffer that all registers of the timer share. */
void
pwm_write(struct pwm_out p, uint32_t value)
{
    uint8_t low = value > 255 ? 255 : (uint8_t)value;
    irqstatus_t flag = irq_save();
    if (p.wide)
        p.compare[1] = 0;
    p.compare[0] = low;
    irq_restore(flag);
}
