/* SPI devices on a bus of the chip's own (board/spi.h). */
#include "basecmd.h"
#include "board/spi.h"
#include "command.h"
#include "spicmds.h"

static void
hardware_prepare(void *bus)
{
    spi_bus_prepare(*(struct spi_bus *)bus);
}

static void
hardware_exchange(void *bus, uint8_t *data, uint8_t len, uint8_t keep_reply)
{
    spi_bus_exchange(*(struct spi_bus *)bus, data, len, keep_reply);
}

static const struct spi_transport hardware = { hardware_prepare, hardware_exchange };

void
command_spi_set_bus(const struct command_args *args)
{
    struct spi_device *d = spi_device_lookup((uint8_t)args->val[0]);
    struct spi_bus *bus = alloc_chunk(sizeof(*bus));
    *bus = spi_bus_open(args->val[1], (uint8_t)args->val[2], args->val[3]);
    spi_device_connect(d, &hardware, bus);
}
DECL_COMMAND(command_spi_set_bus, "spi_set_bus oid=%c spi_bus=%u mode=%u rate=%u");
