/* The SPI: PB3 in, PB2 out, PB1 clock; PB0 must be an output, or a low level there ends master mode (datasheet 21.3.2). */
#include "board/gpio.h"
#include "board/spi.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_ENUMERATION("spi_bus", "spi", 0);
DECL_CONSTANT_STR("BUS_PINS_spi", "PB3,PB2,PB1");

enum { RATES = 7 };  /* 16 MHz divided by 2, 4, ... 128 */

struct spi_bus
spi_bus_open(uint32_t bus, uint8_t mode, uint32_t rate_hz)
{
    if (bus)
        shutdown(SHUTDOWN_SPI_BUS);
    if (mode > 3 || rate_hz < PORT_CLOCK_HZ >> RATES)
        shutdown(SHUTDOWN_SPI_SETUP);
    uint8_t shift = 1;
    while (PORT_CLOCK_HZ >> shift > rate_hz)
        shift++;
    /* SPR is 0: /4, 1: /16, 2: /64, 3: /128; SPI2X halves the divider. */
    uint8_t rate = shift == RATES ? 3 : (uint8_t)((shift - 1) / 2);
    uint8_t twice = shift & 1 && shift != RATES;
    struct spi_bus b = { (uint8_t)(1 << SPE | 1 << MSTR | mode << CPHA | rate), (uint8_t)(twice << SPI2X) };
    if (!(DDRB & 1 << PB0))
        gpio_out_setup(PIN(PORT_B, 0), 1);
    gpio_in_setup(PIN(PORT_B, 3), 1);
    gpio_out_setup(PIN(PORT_B, 2), 0);
    gpio_out_setup(PIN(PORT_B, 1), 0);
    spi_bus_prepare(b);
    return b;
}

void
spi_bus_prepare(struct spi_bus b)
{
    SPCR = b.control;
    SPSR = b.status;
}

void
spi_bus_exchange(struct spi_bus b, uint8_t *data, uint8_t len, uint8_t keep_reply)
{
    (void)b;
    for (uint8_t i = 0; i < len; i++) {
        SPDR = data[i];
        while (!(SPSR & 1 << SPIF))
            ;
        uint8_t reply = SPDR;
        if (keep_reply)
            data[i] = reply;
    }
}
