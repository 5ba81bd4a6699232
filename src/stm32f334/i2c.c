/* I2C1, polled, clocked by the 8 MHz oscillator (the reset state of RCC_CFGR3.I2C1SW), so its timing is the same whatever the
 * rest of the chip runs at.  Timing values: RM0364's examples for 8 MHz. */
#include "board/i2c.h"
#include "board/timer.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_ENUMERATION("i2c_bus", "i2c1", 0);
DECL_CONSTANT_STR("BUS_PINS_i2c1", "PB8,PB9");

enum { FUNCTION_I2C = 4, TIMEOUT_US = 5000, FAST_HZ = 400000, STANDARD_HZ = 100000, SLOW_HZ = 10000 };
#define I2C I2C1_BASE

static uint32_t
timing_for(uint32_t rate_hz)
{
    if (rate_hz >= FAST_HZ)
        return I2C_TIMINGR_PRESC(0) | I2C_TIMINGR_SCLL(0x9) | I2C_TIMINGR_SCLH(0x3) | I2C_TIMINGR_SDADEL(1) |
               I2C_TIMINGR_SCLDEL(3);
    if (rate_hz >= STANDARD_HZ)
        return I2C_TIMINGR_PRESC(1) | I2C_TIMINGR_SCLL(0x13) | I2C_TIMINGR_SCLH(0xf) | I2C_TIMINGR_SDADEL(2) |
               I2C_TIMINGR_SCLDEL(4);
    return I2C_TIMINGR_PRESC(1) | I2C_TIMINGR_SCLL(0xc7) | I2C_TIMINGR_SCLH(0xc3) | I2C_TIMINGR_SDADEL(2) |
           I2C_TIMINGR_SCLDEL(4);
}

struct i2c_bus
i2c_bus_open(uint32_t bus, uint32_t rate_hz, uint8_t address)
{
    if (bus)
        shutdown(SHUTDOWN_I2C_BUS);
    if (rate_hz < SLOW_HZ || address > 0x7f)
        shutdown(SHUTDOWN_I2C_SETUP);
    RCC_APB1ENR |= RCC_APB1ENR_I2C1EN;
    (void)RCC_APB1ENR;
    for (uint32_t pin = PIN_B + 8; pin <= PIN_B + 9; pin++) {
        pin_set_open_drain(pin);
        pin_set_pull(pin, 1);
        pin_set_function(pin, FUNCTION_I2C);
    }
    return (struct i2c_bus){ timing_for(rate_hz), address };
}

/* Until one of `mask` shows in ISR, a NACK comes, or time is up; returns what was seen. */
static uint32_t
wait_for(uint32_t mask, uint32_t start)
{
    uint32_t seen;
    do
        seen = I2C_ISR(I2C) & (mask | I2C_ISR_NACKF);
    while (!seen && timer_read_time() - start < timer_from_us(TIMEOUT_US));
    return seen;
}

/* The peripheral off and on again: it lets go of both lines (RM0364). */
static void
let_go(void)
{
    I2C_CR1(I2C) = 0;
    (void)I2C_CR1(I2C);
    (void)I2C_CR1(I2C);
    (void)I2C_CR1(I2C);
}

static enum i2c_status
failed(uint32_t seen, enum i2c_status nack)
{
    if (!(seen & I2C_ISR_NACKF)) {
        let_go();
        return I2C_TIMEOUT;
    }
    I2C_CR2(I2C) |= I2C_CR2_STOP;
    wait_for(I2C_ISR_STOPF, timer_read_time());
    let_go();
    return nack;
}

static enum i2c_status
write_half(struct i2c_bus b, const uint8_t *data, uint8_t len, uint32_t start)
{
    I2C_CR2(I2C) = I2C_CR2_SADD1(b.address) | I2C_CR2_NBYTES(len) | I2C_CR2_START;
    for (uint8_t i = 0; i < len; i++) {
        uint32_t seen = wait_for(I2C_ISR_TXIS, start);
        if (!(seen & I2C_ISR_TXIS) || seen & I2C_ISR_NACKF)
            return failed(seen, i ? I2C_NACK : I2C_START_NACK);
        I2C_TXDR(I2C) = data[i];
    }
    uint32_t seen = wait_for(I2C_ISR_TC, start);
    if (!(seen & I2C_ISR_TC) || seen & I2C_ISR_NACKF)
        return failed(seen, len ? I2C_NACK : I2C_START_NACK);
    return I2C_SUCCESS;
}

static enum i2c_status
read_half(struct i2c_bus b, uint8_t *data, uint8_t len, uint32_t start)
{
    I2C_CR2(I2C) = I2C_CR2_SADD1(b.address) | I2C_CR2_NBYTES(len) | I2C_CR2_RD_WRN | I2C_CR2_START;
    for (uint8_t i = 0; i < len; i++) {
        uint32_t seen = wait_for(I2C_ISR_RXNE, start);
        if (!(seen & I2C_ISR_RXNE))
            return failed(seen, I2C_START_READ_NACK);
        data[i] = (uint8_t)I2C_RXDR(I2C);
    }
    uint32_t seen = wait_for(I2C_ISR_TC, start);
    return seen & I2C_ISR_TC ? I2C_SUCCESS : failed(seen, I2C_START_READ_NACK);
}

enum i2c_status
i2c_bus_exchange(struct i2c_bus b, const uint8_t *write, uint8_t write_len, uint8_t *read, uint8_t read_len)
{
    uint32_t start = timer_read_time();
    enum i2c_status status = I2C_SUCCESS;
    I2C_CR1(I2C) = 0;
    I2C_TIMINGR(I2C) = b.timing;
    I2C_CR1(I2C) = I2C_CR1_PE;
    I2C_ICR(I2C) = I2C_ICR_NACKCF | I2C_ICR_STOPCF;
    if (write_len || !read_len)
        status = write_half(b, write, write_len, start);
    if (status == I2C_SUCCESS && read_len)
        status = read_half(b, read, read_len, start);
    if (status != I2C_SUCCESS)
        return status;
    I2C_CR2(I2C) |= I2C_CR2_STOP;
    if (!(wait_for(I2C_ISR_STOPF, start) & I2C_ISR_STOPF)) {
        let_go();
        return I2C_TIMEOUT;
    }
    return I2C_SUCCESS;
}
