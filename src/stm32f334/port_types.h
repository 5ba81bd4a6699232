/* What the STM32F334 port puts into the board contract's types, and how it is configured (Kconfig; the defaults here are
 * those of a Nucleo-F334R8). */
#ifndef PORT_TYPES_H
#define PORT_TYPES_H

#include <stdint.h>

#define PORT_CLOCK_HZ 72000000u
#define PORT_MOVE_COUNT_MAX 1024
#define PORT_PWM_MAX 255

/* Leaving the timer interrupt and coming again takes some 60 instructions and two exceptions' ends. */
#define PORT_TIMER_WAIT_TICKS 120
/* 2 us, the usual pulse: waited for, because an interrupt for its end costs more. */
#define PORT_SHORT_PULSE_TICKS 144
/* 20 us for the tasks, if timers leave them none; that is about once a millisecond. */
#define PORT_TIMER_PAUSE_TICKS 1440

/* Samples in a half of the bridge ADC's buffer, two blocks of the usual length: they share an interrupt's cost.
 * Fewer make it shorter (steps wait for it) but cost more in total; the figures are in docs/reference/STM32F334.md. */
#define PORT_SYNC_HALF_LEN 384

/* One comparison: the sign of the difference.  The compiler subtracts and then compares with zero. */
#define PORT_TIMER_IS_BEFORE
static inline uint8_t
timer_is_before(uint32_t a, uint32_t b)
{
    int before;
    __asm__("cmp %1, %2" : "=@ccmi"(before) : "r"(a), "r"(b));
    return (uint8_t)before;
}

#define PORT_WIRE_CRC16 /* wire_crc16() is the chip's: seal.c */

struct gpio_out {
    volatile uint32_t *set_reset;  /* GPIOx_BSRR */
    uint32_t mask;
};
/* ODR follows BSRR directly in the block.  Nothing can come between reading and writing it. */
#define PORT_INLINE_TOGGLE
static inline void
gpio_out_toggle(struct gpio_out g)
{
    g.set_reset[-1] ^= g.mask;
}
struct gpio_in {
    volatile uint32_t *input;      /* GPIOx_IDR */
    uint32_t mask;
};
struct adc_in {
    uint8_t channel;               /* of ADC2; SENSOR (adc.c): of ADC1 */
};
struct pwm_out {
    volatile uint32_t *compare;    /* TIMx_CCRy */
};
struct spi_bus {
    uint16_t control;              /* SPI_CR1: mode and rate */
};
struct i2c_bus {
    uint32_t timing;               /* I2C_TIMINGR */
    uint8_t address;
};

/* All interrupts have one priority, so PRIMASK is all the locking there is. */
typedef uint32_t irqstatus_t;
#define PORT_INLINE_IRQ
static inline void
irq_disable(void)
{
    __asm__ volatile("cpsid i" ::: "memory");
}
static inline void
irq_enable(void)
{
    __asm__ volatile("cpsie i" ::: "memory");
}
static inline irqstatus_t
irq_save(void)
{
    irqstatus_t flag;
    __asm__ volatile("mrs %0, primask" : "=r"(flag));
    irq_disable();
    return flag;
}
static inline void
irq_restore(irqstatus_t flag)
{
    __asm__ volatile("msr primask, %0" ::"r"(flag) : "memory");
}

#endif
