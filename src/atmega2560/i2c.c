/* The TWI (datasheet chapter 24) as an I2C master, polled: PD0 clock, PD1 data, which an Arduino Mega calls 21 and 20.
 *
 * Each step writes TWCR with TWINT, which starts it, and waits until TWINT comes back; TWSR then says how it went.  A device
 * that holds the clock longer than TIMEOUT_US altogether is given up, with the peripheral switched off and on.
 */
#include "board/gpio.h"
#include "board/i2c.h"
#include "board/timer.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_ENUMERATION("i2c_bus", "twi", 0);
DECL_CONSTANT_STR("BUS_PINS_twi", "PD0,PD1");

enum { TIMEOUT_US = 5000, FAST_HZ = 400000, SLOW_HZ = 10000, PRESCALED_BELOW_HZ = 31250 };

/* Status codes, the prescaler's bits masked off (tables 24-3, 24-4). */
enum {
    STATUS_MASK = 0xf8, STATUS_START = 0x08, STATUS_AGAIN = 0x10, STATUS_WRITE_ACK = 0x18, STATUS_DATA_ACK = 0x28,
    STATUS_READ_ACK = 0x40, STATUS_NONE = 0,
};

/* SCL = 16 MHz / (16 + 2 * TWBR * 4^prescaler), no faster than asked for. */
struct i2c_bus
i2c_bus_open(uint32_t bus, uint32_t rate_hz, uint8_t address)
{
    if (bus)
        shutdown(SHUTDOWN_I2C_BUS);
    if (rate_hz < SLOW_HZ || address > 0x7f)
        shutdown(SHUTDOWN_I2C_SETUP);
    if (rate_hz > FAST_HZ)
        rate_hz = FAST_HZ;
    uint8_t prescaler = rate_hz < PRESCALED_BELOW_HZ;
    uint32_t ticks = (PORT_CLOCK_HZ + rate_hz - 1) / rate_hz - 16, unit = prescaler ? 8 : 2;
    PRR0 &= (uint8_t) ~(1 << PRTWI);
    gpio_in_setup(PIN(PORT_D, 0), 1);
    gpio_in_setup(PIN(PORT_D, 1), 1);
    return (struct i2c_bus){ (uint8_t)((ticks + unit - 1) / unit), prescaler, address };
}

/* The next step: `control` beside TWINT and TWEN.  Its status, STATUS_NONE if it took too long. */
static uint8_t
step(uint8_t control, uint32_t begin)
{
    TWCR = (uint8_t)(1 << TWINT | 1 << TWEN | control);
    while (!(TWCR & 1 << TWINT))
        if (timer_read_time() - begin > timer_from_us(TIMEOUT_US))
            return STATUS_NONE;
    return TWSR & STATUS_MASK;
}

/* Start, also a repeated one, and the address with its last bit.  Returns the status. */
static uint8_t
address_device(struct i2c_bus b, uint8_t read, uint32_t begin)
{
    uint8_t status = step(1 << TWSTA, begin);
    if (status != STATUS_START && status != STATUS_AGAIN)
        return STATUS_NONE;
    TWDR = (uint8_t)(b.address << 1 | read);
    return step(0, begin);
}

static enum i2c_status
write_half(struct i2c_bus b, const uint8_t *write, uint8_t len, uint32_t begin)
{
    uint8_t status = address_device(b, 0, begin);
    if (status != STATUS_WRITE_ACK)
        return status == STATUS_NONE ? I2C_TIMEOUT : I2C_START_NACK;
    for (; len; len--) {
        TWDR = *write++;
        status = step(0, begin);
        if (status != STATUS_DATA_ACK)
            return status == STATUS_NONE ? I2C_TIMEOUT : I2C_NACK;
    }
    return I2C_SUCCESS;
}

static enum i2c_status
read_half(struct i2c_bus b, uint8_t *read, uint8_t len, uint32_t begin)
{
    uint8_t status = address_device(b, 1, begin);
    if (status != STATUS_READ_ACK)
        return status == STATUS_NONE ? I2C_TIMEOUT : I2C_START_READ_NACK;
    for (; len; len--) {
        if (step(len > 1 ? 1 << TWEA : 0, begin) == STATUS_NONE)
            return I2C_TIMEOUT;
        *read++ = TWDR;
    }
    return I2C_SUCCESS;
}

/* The stop takes half a clock of the bus; TWSTO goes out with it. */
static enum i2c_status
stop(enum i2c_status status, uint32_t begin)
{
    TWCR = 1 << TWINT | 1 << TWEN | 1 << TWSTO;
    while (TWCR & 1 << TWSTO)
        if (timer_read_time() - begin > timer_from_us(TIMEOUT_US)) {
            TWCR = 0;
            return I2C_TIMEOUT;
        }
    return status;
}

enum i2c_status
i2c_bus_exchange(struct i2c_bus b, const uint8_t *write, uint8_t write_len, uint8_t *read, uint8_t read_len)
{
    uint32_t begin = timer_read_time();
    enum i2c_status status = I2C_SUCCESS;
    TWBR = b.rate;
    TWSR = b.prescaler;
    if (write_len || !read_len)
        status = write_half(b, write, write_len, begin);
    if (status == I2C_SUCCESS && read_len)
        status = read_half(b, read, read_len, begin);
    if (status == I2C_TIMEOUT) {
        TWCR = 0;  /* lets go of both lines */
        return status;
    }
    return stop(status, begin);
}
