/* What the ATmega2560 port puts into the board contract's types.  Register addresses are data-space addresses. */
#ifndef PORT_TYPES_H
#define PORT_TYPES_H

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <stdint.h>

#define PORT_CLOCK_HZ 16000000u
#define PORT_MOVE_COUNT_MAX 1000  /* never reached: memory ends before */

/* Leaving and entering the timer interrupt costs more than this. */
#define PORT_TIMER_WAIT_TICKS 320
#define PORT_TIMER_NEAR

/* While timers run no other interrupt reads or writes the timer's wide registers. */
#define PORT_TIMER_LOW
typedef uint16_t timer_low_t;
static inline timer_low_t
timer_read_low(void)
{
    return TCNT5;
}
static inline uint8_t
timer_read_byte(void)
{
    return TCNT5L;
}
typedef uint16_t __attribute__((may_alias)) timer_half_t;

/* A driver's shortest pulse is 1 to 2 us: 4 are waited for with interrupts allowed. */
#define PORT_SHORT_PULSE_TICKS 64

/* The three registers of a port follow one another: regs[0] is PINx, regs[1] DDRx, regs[2] PORTx. */
struct gpio_out {
    volatile uint8_t *regs;
    uint8_t mask;
};
/* Writing a one to PINx toggles the bit, without reading (datasheet 13.2.2). */
#define PORT_INLINE_TOGGLE
static inline void
gpio_out_toggle(struct gpio_out g)
{
    g.regs[0] = g.mask;
}
struct gpio_in {
    volatile uint8_t *regs;
    uint8_t mask;
};
struct adc_in {
    uint8_t channel;
};
struct pwm_out {
    volatile uint8_t *compare;  /* OCRnx; the low byte of a 16-bit one */
    uint8_t wide;
};
struct spi_bus {
    uint8_t control, status;    /* SPCR, SPSR */
};
struct i2c_bus {
    uint8_t rate, prescaler;    /* TWBR, TWSR */
    uint8_t address;
};
#define PORT_LED_CHAIN          /* led.c: a bit is shorter than a look at the clock */

/* src/flash_data.h: all such tables lie in the first 64 KiB, where LPM reads them. */
#define PORT_FLASH_DATA
#define FLASH_DATA PROGMEM
static inline uint8_t
flash_byte(const void *at)
{
    return pgm_read_byte(at);
}
static inline void
flash_copy(void *to, const void *from, uint8_t size)
{
    memcpy_P(to, from, size);
}

typedef uint8_t irqstatus_t;
#define PORT_INLINE_IRQ
static inline void
irq_disable(void)
{
    __asm__ volatile("cli" ::: "memory");
}
static inline void
irq_enable(void)
{
    __asm__ volatile("sei" ::: "memory");
}
static inline irqstatus_t
irq_save(void)
{
    irqstatus_t flag = SREG;
    irq_disable();
    return flag;
}
static inline void
irq_restore(irqstatus_t flag)
{
    __asm__ volatile("" ::: "memory");
    SREG = flag;
}

#endif
