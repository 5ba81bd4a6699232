/* The smallest set of types that satisfies the board contract: a new port starts from a copy of this file.
 *
 * As it stands it is what `make compile-check` compiles the portable files with, to show that they need nothing but the
 * contract; port.c beside it has a body for each of its functions.
 */
#ifndef PORT_TYPES_H
#define PORT_TYPES_H

#include <stdint.h>

#define PORT_CLOCK_HZ 16000000u
#define PORT_MOVE_COUNT_MAX 500

/* Whatever makes access fast: a register's address and a bit mask, for instance. */
struct gpio_out {
    volatile uint8_t *reg;
    uint8_t bit;
};
struct gpio_in {
    volatile uint8_t *reg;
    uint8_t bit;
};
struct adc_in {
    uint8_t channel;
};
struct pwm_out {
    volatile uint16_t *reg;
};

/* Only with spi_hardware.c and i2c_hardware.c in the source list. */
struct spi_bus {
    volatile uint8_t *regs;
    uint8_t mode, divider;
};
struct i2c_bus {
    volatile uint8_t *regs;
    uint8_t address;
};

typedef uint8_t irqstatus_t;

#endif
