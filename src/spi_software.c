/* SPI devices on any four pins, the clock toggled by hand.
 *
 *     CPHA 0   MOSI ═X═══════X══     the bit stands before the leading edge, both sides sample on it
 *              SCLK ____/‾‾‾\____
 *     CPHA 1   MOSI ═══X════════     the bit changes on the leading edge, both sides sample on the trailing one
 *              SCLK ___/‾‾‾‾\____
 *
 * Each half of the clock lasts at least pulse_ticks.  mode = CPOL * 2 + CPHA; CPOL 1 turns SCLK upside down.
 */
#include "basecmd.h"
#include "board/delay.h"
#include "board/gpio.h"
#include "command.h"
#include "sched.h"
#include "spicmds.h"

enum { PULSE_MAX_US = 100 };  /* slower, and a message would take too long for a task */

struct spi_software {
    struct gpio_in miso;
    struct gpio_out mosi, sclk;
    uint32_t pulse_ticks;
    uint8_t idle_level, late_phase;  /* CPOL, CPHA */
};

static void
software_prepare(void *bus)
{
    struct spi_software *s = bus;
    gpio_out_write(s->sclk, s->idle_level);
}

static uint8_t
exchange_byte(const struct spi_software *s, uint8_t out)
{
    uint8_t in = 0;
    for (uint8_t bit = 0; bit < 8; bit++, out = (uint8_t)(out << 1)) {
        uint8_t level = out >> 7;
        if (s->late_phase)
            gpio_out_write(s->sclk, !s->idle_level);
        gpio_out_write(s->mosi, level);
        delay_ticks(s->pulse_ticks);
        if (s->late_phase)
            gpio_out_write(s->sclk, s->idle_level);
        else
            gpio_out_write(s->sclk, !s->idle_level);
        in = (uint8_t)(in << 1) | gpio_in_read(s->miso);
        delay_ticks(s->pulse_ticks);
        if (!s->late_phase)
            gpio_out_write(s->sclk, s->idle_level);
    }
    return in;
}

static void
software_exchange(void *bus, uint8_t *data, uint8_t len, uint8_t keep_reply)
{
    for (; len; len--, data++) {
        uint8_t in = exchange_byte(bus, *data);
        if (keep_reply)
            *data = in;
    }
}

static const struct spi_transport software = { software_prepare, software_exchange };

void
command_spi_set_sw_bus(const struct command_args *args)
{
    struct spi_device *d = spi_device_lookup((uint8_t)args->val[0]);
    struct spi_software *s = alloc_chunk(sizeof(*s));
    uint32_t mode = args->val[4];
    if (mode > 3 || args->val[5] > timer_from_us(PULSE_MAX_US))
        shutdown(SHUTDOWN_SPI_SETUP);
    s->idle_level = (uint8_t)(mode >> 1);
    s->late_phase = mode & 1;
    s->pulse_ticks = args->val[5];
    s->miso = gpio_in_setup(args->val[1], 1);
    s->mosi = gpio_out_setup(args->val[2], 0);
    s->sclk = gpio_out_setup(args->val[3], s->idle_level);
    spi_device_connect(d, &software, s);
}
DECL_COMMAND(command_spi_set_sw_bus,
             "spi_set_sw_bus oid=%c miso_pin=%u mosi_pin=%u sclk_pin=%u mode=%u pulse_ticks=%u");
