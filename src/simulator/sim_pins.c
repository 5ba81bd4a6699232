/* The simulated chip's pins: every one can be a digital output or input, a slow analog input, a PWM output. */
#include "board/adc.h"
#include "board/gpio.h"
#include "board/pwm.h"
#include "command.h"
#include "sched.h"
#include "sim_internal.h"

DECL_CONSTANT("ADC_MAX", SIM_ADC_MAX);
DECL_CONSTANT("PWM_MAX", SIM_PWM_MAX);
DECL_ENUMERATION_RANGE("pin", "PA0", 0, 16);
DECL_ENUMERATION_RANGE("pin", "PB0", 16, 16);
DECL_ENUMERATION_RANGE("pin", "PC0", 32, 16);
DECL_ENUMERATION_RANGE("pin", "PD0", 48, 16);
DECL_ENUMERATION_RANGE("pin", "PE0", 64, 16);
DECL_ENUMERATION_RANGE("pin", "PF0", 80, 16);
DECL_ENUMERATION_RANGE("pin", "PG0", 96, 16);
DECL_ENUMERATION_RANGE("pin", "PH0", 112, 16);
DECL_ENUMERATION("pin", "ADC_TEMPERATURE", SIM_PIN_TEMPERATURE);

static struct {
    uint8_t level[SIM_PIN_COUNT];          /* of outputs, as last written */
    uint8_t driven[SIM_PIN_COUNT];         /* set up as an output last */
    uint32_t pwm_cycle_ticks[SIM_PIN_COUNT];
} pins;

void
sim_pins_init(void)
{
    for (uint32_t pin = 0; pin < SIM_PIN_COUNT; pin++)
        pins.level[pin] = pins.driven[pin] = pins.pwm_cycle_ticks[pin] = 0;
}
DECL_INIT(sim_pins_init);

static void
drive(uint32_t pin, uint8_t value)
{
    pins.level[pin] = value;
    sim_board.pin_write(sim_board.ctx, pin, value, sim_now());
}

struct gpio_out
gpio_out_setup(uint32_t pin, uint8_t value)
{
    if (pin >= SIM_PIN_COUNT)
        shutdown(SHUTDOWN_NOT_OUTPUT_PIN);
    pins.driven[pin] = 1;
    drive(pin, !!value);
    return (struct gpio_out){ pin };
}

void
gpio_out_write(struct gpio_out g, uint8_t value)
{
    drive(g.pin, !!value);
}

void
gpio_out_toggle(struct gpio_out g)
{
    drive(g.pin, !pins.level[g.pin]);
}

struct gpio_in
gpio_in_setup(uint32_t pin, int8_t pull)
{
    if (pin >= SIM_PIN_COUNT)
        shutdown(SHUTDOWN_NOT_INPUT_PIN);
    /* An output let go floats to its pull-up; otherwise the world's switches always drive their pins. */
    if (pins.driven[pin] && pull > 0)
        drive(pin, 1);
    pins.driven[pin] = 0;
    return (struct gpio_in){ pin };
}

uint8_t
gpio_in_read(struct gpio_in g)
{
    return !!sim_board.pin_read(sim_board.ctx, g.pin, sim_now());
}

/* Conversions take no time: time stands still while firmware runs, and nothing here depends on their duration. */
struct adc_in
adc_setup(uint32_t pin)
{
    if (pin >= SIM_PIN_COUNT && pin != SIM_PIN_TEMPERATURE)
        shutdown(SHUTDOWN_NOT_ADC_PIN);
    return (struct adc_in){ pin };
}

uint32_t
adc_poll(struct adc_in a)
{
    (void)a;
    return 0;
}

uint16_t
adc_take(struct adc_in a)
{
    uint16_t code = sim_board.adc_read(sim_board.ctx, a.pin, sim_clock);
    return code > SIM_ADC_MAX ? SIM_ADC_MAX : code;
}

void
adc_cancel(struct adc_in a)
{
    (void)a;
}

struct pwm_out
pwm_setup(uint32_t pin, uint32_t cycle_ticks, uint32_t value)
{
    if (pin >= SIM_PIN_COUNT)
        shutdown(SHUTDOWN_NOT_PWM_PIN);
    pins.pwm_cycle_ticks[pin] = cycle_ticks;
    struct pwm_out p = { pin };
    pwm_write(p, value);
    return p;
}

void
pwm_write(struct pwm_out p, uint32_t value)
{
    if (value > SIM_PWM_MAX)
        value = SIM_PWM_MAX;
    sim_board.pwm_write(sim_board.ctx, p.pin, pins.pwm_cycle_ticks[p.pin], value, sim_clock);
}
