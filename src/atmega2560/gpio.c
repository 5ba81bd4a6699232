/* Digital pins.  A port's three registers lie together, but the ports themselves do not: A to G below 0x40, the rest above
 * 0x100, hence the table. */
#include "board/gpio.h"
#include "board/irq.h"
#include "command.h"
#include "flash_data.h"
#include "internal.h"
#include "sched.h"

DECL_ENUMERATION_RANGE("pin", "PA0", 0, 8);
DECL_ENUMERATION_RANGE("pin", "PB0", 8, 8);
DECL_ENUMERATION_RANGE("pin", "PC0", 16, 8);
DECL_ENUMERATION_RANGE("pin", "PD0", 24, 8);
DECL_ENUMERATION_RANGE("pin", "PE0", 32, 8);
DECL_ENUMERATION_RANGE("pin", "PF0", 40, 8);
DECL_ENUMERATION_RANGE("pin", "PG0", 48, 6);
DECL_ENUMERATION_RANGE("pin", "PH0", 56, 8);
DECL_ENUMERATION_RANGE("pin", "PJ0", 64, 8);
DECL_ENUMERATION_RANGE("pin", "PK0", 72, 8);
DECL_ENUMERATION_RANGE("pin", "PL0", 80, 8);
DECL_CONSTANT_STR("RESERVE_PINS_serial", "PE0,PE1");

enum { DDR = 1, PORT = 2 };

static const uint16_t port_registers[PORT_COUNT] FLASH_DATA = {
    (uint16_t)&PINA, (uint16_t)&PINB, (uint16_t)&PINC, (uint16_t)&PIND, (uint16_t)&PINE, (uint16_t)&PINF,
    (uint16_t)&PING, (uint16_t)&PINH, (uint16_t)&PINJ, (uint16_t)&PINK, (uint16_t)&PINL,
};

uint8_t
pin_is_free(uint32_t pin)
{
    return pin < PIN(PORT_COUNT, 0) && pin != PIN(PORT_G, 6) && pin != PIN(PORT_G, 7) && pin != PIN(PORT_E, 0) &&
           pin != PIN(PORT_E, 1);
}

static volatile uint8_t *
registers_of(uint32_t pin)
{
    return (volatile uint8_t *)pgm_read_word(&port_registers[(uint8_t)pin / 8]);
}

/* Interrupts disabled. */
static void
write_bits(volatile uint8_t *reg, uint8_t mask, uint8_t on)
{
    if (on)
        *reg |= mask;
    else
        *reg &= (uint8_t)~mask;
}

struct gpio_out
gpio_out_setup(uint32_t pin, uint8_t value)
{
    if (!pin_is_free(pin))
        shutdown(SHUTDOWN_NOT_OUTPUT_PIN);
    struct gpio_out g = { registers_of(pin), (uint8_t)(1 << (pin & 7)) };
    irqstatus_t flag = irq_save();
    write_bits(g.regs + PORT, g.mask, value);
    write_bits(g.regs + DDR, g.mask, 1);
    irq_restore(flag);
    return g;
}

void
gpio_out_write(struct gpio_out g, uint8_t value)
{
    irqstatus_t flag = irq_save();
    write_bits(g.regs + PORT, g.mask, value);
    irq_restore(flag);
}

struct gpio_in
gpio_in_setup(uint32_t pin, int8_t pull)
{
    if (!pin_is_free(pin) || pull < 0)  /* the chip has no pull-downs */
        shutdown(SHUTDOWN_NOT_INPUT_PIN);
    struct gpio_in g = { registers_of(pin), (uint8_t)(1 << (pin & 7)) };
    irqstatus_t flag = irq_save();
    write_bits(g.regs + DDR, g.mask, 0);
    write_bits(g.regs + PORT, g.mask, pull > 0);
    irq_restore(flag);
    return g;
}

uint8_t
gpio_in_read(struct gpio_in g)
{
    return (g.regs[0] & g.mask) != 0;
}
