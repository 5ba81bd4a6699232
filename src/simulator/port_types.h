/* What the simulator port puts into the board contract's types. */
#ifndef PORT_TYPES_H
#define PORT_TYPES_H

#include <stdint.h>

#define PORT_CLOCK_HZ 72000000u
#define PORT_MOVE_COUNT_MAX 1024
#define SIM_ADC_MAX 4095
#define SIM_PWM_MAX 255

struct gpio_out {
    uint32_t pin;
};
struct gpio_in {
    uint32_t pin;
};
struct adc_in {
    uint32_t pin;
};
struct pwm_out {
    uint32_t pin;
};
struct spi_bus {
    uint32_t bus, rate_hz;
    uint8_t mode;
};
struct i2c_bus {
    uint32_t bus;
    uint8_t address;
};

#define PORT_DELAY

/* Firmware code is never interrupted here, so there is nothing to lock. */
typedef uint8_t irqstatus_t;
#define PORT_INLINE_IRQ
static inline void
irq_disable(void)
{
}
static inline void
irq_enable(void)
{
}
static inline irqstatus_t
irq_save(void)
{
    return 0;
}
static inline void
irq_restore(irqstatus_t flag)
{
    (void)flag;
}

#endif
