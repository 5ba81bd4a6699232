/* A port to no chip: every function of the board contract (src/board/, whose headers say what each must do) with the shortest
 * body that is right.  What is simulated here by a variable is a register on a chip.  `make compile-check` compiles it
 * with all compilers, so it cannot fall behind the contract.  docs/reference/Porting.md says in which order to fill it in.
 */
#include "board/adc.h"
#include "board/bridge_pwm.h"
#include "board/console.h"
#include "board/gpio.h"
#include "board/i2c.h"
#include "board/irq.h"
#include "board/misc.h"
#include "board/pwm.h"
#include "board/spi.h"
#include "board/sync_adc.h"
#include "board/timer.h"
#include "board/watchdog.h"
#include "command.h"
#include "sched.h"

DECL_CONSTANT_STR("MCU", "template");
DECL_CONSTANT("CLOCK_FREQ", 16000000);
DECL_CONSTANT("SERIAL_BAUD", 250000);
DECL_CONSTANT("RECEIVE_WINDOW", 192);
DECL_CONSTANT("ADC_MAX", 1023);
DECL_CONSTANT("PWM_MAX", 255);
DECL_CONSTANT("BRIDGE_PHASE_MAX", 45000);
DECL_ENUMERATION_RANGE("pin", "PA0", 0, 8);
DECL_ENUMERATION("spi_bus", "spi0", 0);
DECL_CONSTANT_STR("BUS_PINS_spi0", "PA0,PA1,PA2");
DECL_ENUMERATION("i2c_bus", "i2c0", 0);
DECL_CONSTANT_STR("BUS_PINS_i2c0", "PA3,PA4");

enum { PIN_COUNT = 8, ARENA_SIZE = 4096 };

static volatile uint8_t pin_register;       /* 8 pins, a bit each */
static volatile uint16_t pwm_register;
static volatile uint8_t bus_register;
static volatile uint32_t clock_register, compare_register;
static union {
    void *aligned;
    uint8_t bytes[ARENA_SIZE];
} arena;

int main(void);
void timer_interrupt(void);

/* ---- timer.h, irq.h: first of all ---- */

uint32_t
timer_read_time(void)
{
    return clock_register;
}

void
timer_kick(void)
{
    compare_register = sched_next_waketime(); /* and raise the interrupt at once if that has passed */
}

void
timer_interrupt(void)
{
    compare_register = sched_timer_dispatch();
}

void
irq_disable(void)
{
}

void
irq_enable(void)
{
}

irqstatus_t
irq_save(void)
{
    return 0;
}

void
irq_restore(irqstatus_t flag)
{
    (void)flag;
}

void
irq_wait(void)
{
}

/* ---- console.h: now it talks ---- */

uint8_t
console_read(uint8_t *byte)
{
    (void)byte;
    return 0;
}

void
console_send(const uint8_t *block, uint8_t len)
{
    (void)block;
    (void)len;
}

/* ---- misc.h, watchdog.h ---- */

size_t
board_arena(void **start)
{
    *start = arena.bytes;
    return sizeof(arena);
}

void
board_reset(void)
{
}

uint32_t
board_peek(uint8_t order, uint32_t address)
{
    (void)order;
    (void)address;
    return 0;
}

void
board_poke(uint8_t order, uint32_t address, uint32_t value)
{
    (void)order;
    (void)address;
    (void)value;
}

void
watchdog_start(void)
{
}

void
watchdog_feed(void)
{
}

/* ---- gpio.h: steppers, endstops, software PWM and buses ---- */

struct gpio_out
gpio_out_setup(uint32_t pin, uint8_t value)
{
    if (pin >= PIN_COUNT)
        shutdown(SHUTDOWN_NOT_OUTPUT_PIN);
    struct gpio_out g = { &pin_register, (uint8_t)(1u << pin) };
    gpio_out_write(g, value);
    return g;
}

/* An object whose set-up ended in a shutdown has no pin yet, and its DECL_SHUTDOWN function writes all the same. */
void
gpio_out_write(struct gpio_out g, uint8_t value)
{
    if (g.reg)
        *g.reg = (uint8_t)(value ? *g.reg | g.bit : *g.reg & ~g.bit);
}

void
gpio_out_toggle(struct gpio_out g)
{
    *g.reg ^= g.bit;
}

struct gpio_in
gpio_in_setup(uint32_t pin, int8_t pull)
{
    (void)pull;
    if (pin >= PIN_COUNT)
        shutdown(SHUTDOWN_NOT_INPUT_PIN);
    return (struct gpio_in){ &pin_register, (uint8_t)(1u << pin) };
}

uint8_t
gpio_in_read(struct gpio_in g)
{
    return (*g.reg & g.bit) != 0;
}

/* ---- adc.h, pwm.h: heaters ---- */

struct adc_in
adc_setup(uint32_t pin)
{
    if (pin >= PIN_COUNT)
        shutdown(SHUTDOWN_NOT_ADC_PIN);
    return (struct adc_in){ (uint8_t)pin };
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
    return a.channel;
}

void
adc_cancel(struct adc_in a)
{
    (void)a;
}

struct pwm_out
pwm_setup(uint32_t pin, uint32_t cycle_ticks, uint32_t value)
{
    (void)cycle_ticks;
    if (pin >= PIN_COUNT)
        shutdown(SHUTDOWN_NOT_PWM_PIN);
    struct pwm_out p = { &pwm_register };
    pwm_write(p, value);
    return p;
}

void
pwm_write(struct pwm_out p, uint32_t value)
{
    if (p.reg)
        *p.reg = (uint16_t)value;
}

/* ---- spi.h, i2c.h: only with FIRMWARE_BUS_HARDWARE in PORT_FIRMWARE ---- */

struct spi_bus
spi_bus_open(uint32_t bus, uint8_t mode, uint32_t rate_hz)
{
    if (bus)
        shutdown(SHUTDOWN_SPI_BUS);
    if (mode > 3 || !rate_hz)
        shutdown(SHUTDOWN_SPI_SETUP);
    return (struct spi_bus){ &bus_register, mode, 0 };
}

void
spi_bus_prepare(struct spi_bus b)
{
    (void)b;
}

void
spi_bus_exchange(struct spi_bus b, uint8_t *data, uint8_t len, uint8_t keep_reply)
{
    for (; len--; data++) {
        *b.regs = *data;
        if (keep_reply)
            *data = *b.regs;
    }
}

struct i2c_bus
i2c_bus_open(uint32_t bus, uint32_t rate_hz, uint8_t address)
{
    if (bus)
        shutdown(SHUTDOWN_I2C_BUS);
    if (!rate_hz)
        shutdown(SHUTDOWN_I2C_SETUP);
    return (struct i2c_bus){ &bus_register, address };
}

enum i2c_status
i2c_bus_exchange(struct i2c_bus b, const uint8_t *write, uint8_t write_len, uint8_t *read, uint8_t read_len)
{
    (void)b;
    (void)write;
    (void)read;
    (void)read_len;
    return write_len ? I2C_START_NACK : I2C_START_READ_NACK;
}

/* ---- bridge_pwm.h, sync_adc.h: only with FIRMWARE_INDUCTION.  No hardware, no bridge ---- */

struct bridge_pwm
bridge_pwm_setup(uint8_t id, uint32_t period_ticks)
{
    (void)id;
    (void)period_ticks;
    shutdown(SHUTDOWN_BRIDGE_ID);
}

void
bridge_pwm_set_phase(struct bridge_pwm b, uint16_t phase)
{
    (void)b;
    (void)phase;
}

void
bridge_pwm_off(struct bridge_pwm b)
{
    (void)b;
}

struct sync_adc
sync_adc_setup(uint32_t pin, struct bridge_pwm bridge, uint16_t half_len, sync_adc_ready_fn ready)
{
    (void)pin;
    (void)bridge;
    (void)half_len;
    (void)ready;
    shutdown(SHUTDOWN_SYNC_ADC);
}

uint32_t
sync_adc_start(struct sync_adc a)
{
    (void)a;
    return 0;
}

uint32_t
sync_adc_position(struct sync_adc a)
{
    (void)a;
    return 0;
}

void
sync_adc_move(struct sync_adc a, uint16_t ticks)
{
    (void)a;
    (void)ticks;
}

int
main(void)
{
    sched_main();
    return 0;
}
