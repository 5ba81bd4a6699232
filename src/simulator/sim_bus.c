/* The simulated chip's SPI and I2C peripherals: two buses each, all bytes of a transfer handed to the world at once. */
#include <string.h>

#include "board/i2c.h"
#include "board/spi.h"
#include "command.h"
#include "sched.h"
#include "sim_internal.h"

enum { BUS_COUNT = 2, SPI_MODE_MAX = 3 };

DECL_ENUMERATION_RANGE("spi_bus", "spi0", 0, 2);
DECL_CONSTANT_STR("BUS_PINS_spi0", "PG0,PG1,PG2");
DECL_CONSTANT_STR("BUS_PINS_spi1", "PG3,PG4,PG5");
DECL_ENUMERATION_RANGE("i2c_bus", "i2c0", 0, 2);
DECL_CONSTANT_STR("BUS_PINS_i2c0", "PG6,PG7");
DECL_CONSTANT_STR("BUS_PINS_i2c1", "PG8,PG9");

struct spi_bus
spi_bus_open(uint32_t bus, uint8_t mode, uint32_t rate_hz)
{
    if (bus >= BUS_COUNT)
        shutdown(SHUTDOWN_SPI_BUS);
    if (mode > SPI_MODE_MAX || !rate_hz)
        shutdown(SHUTDOWN_SPI_SETUP);
    return (struct spi_bus){ bus, rate_hz, mode };
}

void
spi_bus_prepare(struct spi_bus b)
{
    (void)b;
}

void
spi_bus_exchange(struct spi_bus b, uint8_t *data, uint8_t len, uint8_t keep_reply)
{
    uint8_t copy[UINT8_MAX];
    memcpy(copy, data, len);
    if (sim_board.spi_exchange)
        sim_board.spi_exchange(sim_board.ctx, b.bus, b.mode, copy, len, sim_clock);
    else
        memset(copy, 0xff, len);
    if (keep_reply)
        memcpy(data, copy, len);
}

struct i2c_bus
i2c_bus_open(uint32_t bus, uint32_t rate_hz, uint8_t address)
{
    if (bus >= BUS_COUNT)
        shutdown(SHUTDOWN_I2C_BUS);
    if (!rate_hz)
        shutdown(SHUTDOWN_I2C_SETUP);
    return (struct i2c_bus){ bus, address };
}

enum i2c_status
i2c_bus_exchange(struct i2c_bus b, const uint8_t *write, uint8_t write_len, uint8_t *read, uint8_t read_len)
{
    if (!sim_board.i2c_exchange)
        return write_len ? I2C_START_NACK : I2C_START_READ_NACK;
    return sim_board.i2c_exchange(sim_board.ctx, b.bus, b.address, write, write_len, read, read_len, sim_clock);
}
