/* Digital pins.  BSRR sets and clears single pins without reading, so nothing here needs a lock but the set-up.  Only
 * gpio_out_toggle (port_types.h) reads and writes ODR: it is called where nothing can come between. */
#include "board/gpio.h"
#include "board/irq.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

/* LQFP64: ports A, B, C, and PD2, PF0, PF1. */
DECL_ENUMERATION_RANGE("pin", "PA0", 0, 16);
DECL_ENUMERATION_RANGE("pin", "PB0", 16, 16);
DECL_ENUMERATION_RANGE("pin", "PC0", 32, 16);
DECL_ENUMERATION("pin", "PD2", 50);
DECL_ENUMERATION_RANGE("pin", "PF0", 80, 2);
DECL_CONSTANT_STR("RESERVE_PINS_serial", "PA3,PA2");
DECL_CONSTANT_STR("RESERVE_PINS_debugger", "PA13,PA14");
DECL_CONSTANT_STR("RESERVE_PINS_crystal", "PF0,PF1");
DECL_CONSTANT_STR("RESERVE_PINS_bridge", "PA8,PA9,PA10,PA11,PA12");

static uint32_t
gpio_of(uint32_t pin)
{
    return GPIOA_BASE + (pin / 16) * GPIO_STRIDE;
}

uint8_t
pin_exists(uint32_t pin)
{
    return pin < PIN_D || pin == PIN_D + 2 || pin == PIN_F || pin == PIN_F + 1;
}

uint8_t
pin_is_free(uint32_t pin)
{
    const uint32_t taken_a = BIT(2) | BIT(3) | BIT(8) | BIT(9) | BIT(10) | BIT(11) | BIT(12) | BIT(13) | BIT(14);
    return pin_exists(pin) && pin < PIN_F && !(pin < PIN_B && taken_a >> pin & 1u);
}

static void
change(volatile uint32_t *reg, uint32_t clear, uint32_t set)
{
    irqstatus_t flag = irq_save();
    *reg = (*reg & ~clear) | set;
    irq_restore(flag);
}

void
pin_set_mode(uint32_t pin, enum pin_mode mode)
{
    uint32_t shift = 2 * (pin % 16);
    change(&GPIO_MODER(gpio_of(pin)), 3u << shift, (uint32_t)mode << shift);
}

void
pin_set_pull(uint32_t pin, int8_t pull)
{
    uint32_t shift = 2 * (pin % 16);
    change(&GPIO_PUPDR(gpio_of(pin)), 3u << shift, (pull > 0 ? 1u : pull < 0 ? 2u : 0u) << shift);
}

void
pin_set_function(uint32_t pin, uint8_t function)
{
    uint32_t gpio = gpio_of(pin), shift = 4 * (pin % 8);
    volatile uint32_t *select = pin % 16 < 8 ? &GPIO_AFRL(gpio) : &GPIO_AFRH(gpio);
    change(select, 15u << shift, (uint32_t)function << shift);
    change(&GPIO_OSPEEDR(gpio), 0, 3u << 2 * (pin % 16));
    pin_set_mode(pin, PIN_ALTERNATE);
}

void
pin_set_open_drain(uint32_t pin)
{
    change(&GPIO_OTYPER(gpio_of(pin)), 0, BIT(pin % 16));
}

uint8_t
pin_level(uint32_t pin)
{
    return GPIO_IDR(gpio_of(pin)) >> (pin % 16) & 1u;
}

/****************************************************************
 * Board contract
 ****************************************************************/

struct gpio_out
gpio_out_setup(uint32_t pin, uint8_t value)
{
    if (!pin_is_free(pin))
        shutdown(SHUTDOWN_NOT_OUTPUT_PIN);
    struct gpio_out g = { &GPIO_BSRR(gpio_of(pin)), BIT(pin % 16) };
    gpio_out_write(g, value); /* the level first, then the driver */
    pin_set_pull(pin, 0);
    change(&GPIO_OTYPER(gpio_of(pin)), BIT(pin % 16), 0);
    pin_set_mode(pin, PIN_OUTPUT);
    return g;
}

/* An object whose set-up ended in a shutdown has no pin yet, and its DECL_SHUTDOWN function writes all the same. */
void
gpio_out_write(struct gpio_out g, uint8_t value)
{
    if (!g.set_reset)
        return;
    *g.set_reset = value ? g.mask : g.mask << 16;
}

struct gpio_in
gpio_in_setup(uint32_t pin, int8_t pull)
{
    if (!pin_is_free(pin))
        shutdown(SHUTDOWN_NOT_INPUT_PIN);
    pin_set_pull(pin, pull);
    pin_set_mode(pin, PIN_INPUT);
    return (struct gpio_in){ &GPIO_IDR(gpio_of(pin)), BIT(pin % 16) };
}

uint8_t
gpio_in_read(struct gpio_in g)
{
    return (*g.input & g.mask) != 0;
}
