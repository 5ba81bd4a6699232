/* I2C devices on any two pins, as the bus's only master.
 *
 * A line is either pulled low (output 0) or let go (input with pull-up; the bus needs its own resistors all the same):
 *
 *     SDA  ‾‾\______X=======X=======X ... ______/‾‾      start: SDA falls while SCL is high
 *     SCL  ‾‾‾‾‾\____/‾‾‾\___/‾‾‾\___ ... ___/‾‾‾‾‾      bits: SDA stands while SCL is high; stop: SDA rises
 *
 * Each half of the clock lasts at least pulse_ticks.  A device may hold SCL low for up to STRETCH_US.
 */
#include "basecmd.h"
#include "board/delay.h"
#include "board/gpio.h"
#include "command.h"
#include "i2ccmds.h"
#include "sched.h"

enum { STRETCH_US = 1000, PULSE_MAX_US = 100 };

struct i2c_software {
    uint32_t scl_pin, sda_pin;
    struct gpio_in scl, sda;
    uint32_t pulse_ticks;
    uint8_t address;   /* shifted: the lowest bit is read/write */
    uint8_t stuck;     /* a device held SCL too long in this transfer */
};

static void
pull_low(uint32_t pin)
{
    gpio_out_setup(pin, 0);
}

static void
let_go_sda(struct i2c_software *s)
{
    s->sda = gpio_in_setup(s->sda_pin, 1);
}

/* SCL up, and wait until it is: a slow device stretches the clock. */
static void
let_go_scl(struct i2c_software *s)
{
    s->scl = gpio_in_setup(s->scl_pin, 1);
    uint32_t limit = timer_read_time() + timer_from_us(STRETCH_US);
    while (!s->stuck && !gpio_in_read(s->scl)) {
        delay_ticks(s->pulse_ticks);
        s->stuck = timer_is_before(limit, timer_read_time());
    }
    delay_ticks(s->pulse_ticks);
}

static void
clock_low(struct i2c_software *s)
{
    pull_low(s->scl_pin);
    delay_ticks(s->pulse_ticks);
}

static void
send_bit(struct i2c_software *s, uint8_t bit)
{
    if (bit)
        let_go_sda(s);
    else
        pull_low(s->sda_pin);
    let_go_scl(s);
    clock_low(s);
}

static uint8_t
receive_bit(struct i2c_software *s)
{
    let_go_sda(s);
    let_go_scl(s);
    uint8_t bit = gpio_in_read(s->sda);
    clock_low(s);
    return bit;
}

/* Also a repeated start: both lines are let go first.  SDA that stays low is held by another; nothing can be sent. */
static void
start(struct i2c_software *s)
{
    let_go_sda(s);
    let_go_scl(s);
    if (!gpio_in_read(s->sda))
        s->stuck = 1;
    pull_low(s->sda_pin);
    delay_ticks(s->pulse_ticks);
    clock_low(s);
}

static void
stop(struct i2c_software *s)
{
    pull_low(s->sda_pin);
    delay_ticks(s->pulse_ticks);
    let_go_scl(s);
    let_go_sda(s);
    delay_ticks(s->pulse_ticks);
}

/* Returns 1 if it was acknowledged. */
static uint8_t
send_byte(struct i2c_software *s, uint8_t byte)
{
    for (uint8_t bit = 0; bit < 8; bit++, byte = (uint8_t)(byte << 1))
        send_bit(s, byte >> 7);
    return !receive_bit(s);
}

static uint8_t
receive_byte(struct i2c_software *s, uint8_t last)
{
    uint8_t byte = 0;
    for (uint8_t bit = 0; bit < 8; bit++)
        byte = (uint8_t)(byte << 1) | receive_bit(s);
    send_bit(s, last);
    return byte;
}

static enum i2c_status
write_half(struct i2c_software *s, const uint8_t *write, uint8_t write_len)
{
    start(s);
    if (!s->stuck && !send_byte(s, s->address))
        return I2C_START_NACK;
    for (; write_len && !s->stuck; write_len--)
        if (!send_byte(s, *write++))
            return I2C_NACK;
    return I2C_SUCCESS;
}

static enum i2c_status
read_half(struct i2c_software *s, uint8_t *read, uint8_t read_len)
{
    start(s);
    if (!s->stuck && !send_byte(s, s->address | 1))
        return I2C_START_READ_NACK;
    for (; read_len && !s->stuck; read_len--)
        *read++ = receive_byte(s, read_len == 1);
    return I2C_SUCCESS;
}

static enum i2c_status
software_exchange(void *bus, const uint8_t *write, uint8_t write_len, uint8_t *read, uint8_t read_len)
{
    struct i2c_software *s = bus;
    enum i2c_status status = I2C_SUCCESS;
    s->stuck = 0;
    if (write_len || !read_len)
        status = write_half(s, write, write_len);
    if (status == I2C_SUCCESS && read_len && !s->stuck)
        status = read_half(s, read, read_len);
    stop(s);
    return s->stuck ? I2C_TIMEOUT : status;
}

void
command_i2c_set_sw_bus(const struct command_args *args)
{
    struct i2c_device *d = i2c_device_lookup((uint8_t)args->val[0]);
    struct i2c_software *s = alloc_chunk(sizeof(*s));
    if (args->val[4] > 0x7f || !args->val[3] || args->val[3] > timer_from_us(PULSE_MAX_US))
        shutdown(SHUTDOWN_I2C_SETUP);
    s->scl_pin = args->val[1];
    s->sda_pin = args->val[2];
    s->scl = gpio_in_setup(s->scl_pin, 1);
    s->sda = gpio_in_setup(s->sda_pin, 1);
    s->pulse_ticks = args->val[3];
    s->address = (uint8_t)(args->val[4] << 1);
    i2c_device_connect(d, software_exchange, s);
}
DECL_COMMAND(command_i2c_set_sw_bus, "i2c_set_sw_bus oid=%c scl_pin=%u sda_pin=%u pulse_ticks=%u address=%u");
