/* Commands for devices on an SPI bus.
 *
 *     spi_transfer ─► chip select ─► transport: hardware (board/spi.h) or pins toggled by hand ─► spi_transfer_response
 *
 * A device is configured in two steps: config_spi (or config_spi_without_cs) makes it, spi_set_bus or spi_set_sw_bus
 * gives it its transport.  config_spi_shutdown adds a message that is sent to the device when the firmware shuts down
 * (stepper drivers are released so, for instance).
 */
#include "spicmds.h"

#include <string.h>

#include "basecmd.h"
#include "board/gpio.h"
#include "command.h"
#include "sched.h"

DECL_RESPONSE(response_spi_transfer, "spi_transfer_response oid=%c response=%*s");

enum { SPI_DATA_MAX = 56 };  /* a block's content is 59 bytes: id, oid and length take at least 3 */

struct spi_device {
    const struct spi_transport *transport;  /* NULL: not connected yet */
    void *bus;
    struct gpio_out cs;
    uint8_t has_cs, active_level;
};

struct spi_shutdown {
    struct spi_device *device;
    uint8_t len;
    uint8_t data[];
};

void
command_config_spi(const struct command_args *args)
{
    uint8_t active_level = !!args->val[2];
    struct gpio_out cs = gpio_out_setup(args->val[1], !active_level);
    struct spi_device *d = oid_alloc((uint8_t)args->val[0], command_config_spi, sizeof(*d));
    d->active_level = active_level;
    d->cs = cs;
    d->has_cs = 1;
}
DECL_COMMAND(command_config_spi, "config_spi oid=%c pin=%u cs_active_high=%c");

void
command_config_spi_without_cs(const struct command_args *args)
{
    oid_alloc((uint8_t)args->val[0], command_config_spi, sizeof(struct spi_device));
}
DECL_COMMAND(command_config_spi_without_cs, "config_spi_without_cs oid=%c");

struct spi_device *
spi_device_lookup(uint8_t oid)
{
    return oid_lookup(oid, command_config_spi);
}

void
spi_device_connect(struct spi_device *d, const struct spi_transport *transport, void *bus)
{
    d->bus = bus;
    d->transport = transport;
}

void
spi_device_exchange(struct spi_device *d, uint8_t *data, uint8_t len, uint8_t keep_reply)
{
    if (!d->transport)
        shutdown(SHUTDOWN_SPI_CONFIG);
    d->transport->prepare(d->bus);
    if (d->has_cs)
        gpio_out_write(d->cs, d->active_level);
    d->transport->exchange(d->bus, data, len, keep_reply);
    if (d->has_cs)
        gpio_out_write(d->cs, !d->active_level);
}

/* The command's bytes lie in the receive buffer, which an exchange must not overwrite. */
static uint8_t
exchange_copy(const struct command_args *args, uint8_t *data, uint8_t keep_reply)
{
    uint8_t len = args->data_len < SPI_DATA_MAX ? args->data_len : SPI_DATA_MAX;
    memcpy(data, args->data, len);
    spi_device_exchange(spi_device_lookup((uint8_t)args->val[0]), data, len, keep_reply);
    return len;
}

void
command_spi_transfer(const struct command_args *args)
{
    uint8_t data[SPI_DATA_MAX];
    unsigned int len = exchange_copy(args, data, 1);
    respond(&response_spi_transfer, (uint8_t)args->val[0], len, data);
}
DECL_COMMAND(command_spi_transfer, "spi_transfer oid=%c data=%*s");

void
command_spi_send(const struct command_args *args)
{
    uint8_t data[SPI_DATA_MAX];
    exchange_copy(args, data, 0);
}
DECL_COMMAND(command_spi_send, "spi_send oid=%c data=%*s");

void
command_config_spi_shutdown(const struct command_args *args)
{
    uint16_t size = (uint16_t)(sizeof(struct spi_shutdown) + args->data_len);
    struct spi_device *device = spi_device_lookup((uint8_t)args->val[1]);
    struct spi_shutdown *s = oid_alloc((uint8_t)args->val[0], command_config_spi_shutdown, size);
    s->device = device;
    s->len = args->data_len;
    memcpy(s->data, args->data, args->data_len);
}
DECL_COMMAND(command_config_spi_shutdown, "config_spi_shutdown oid=%c spi_oid=%c shutdown_msg=%*s");

/* A transfer may have been cut short: every chip is deselected before any of them is spoken to. */
void
spi_shutdown(void)
{
    uint8_t i;
    struct spi_device *d;
    foreach_oid(i, d, command_config_spi)
        if (d->has_cs)
            gpio_out_write(d->cs, !d->active_level);
    struct spi_shutdown *s;
    foreach_oid(i, s, command_config_spi_shutdown) {
        uint8_t data[SPI_DATA_MAX];
        if (!s->device->transport || s->len > sizeof(data))
            continue;
        memcpy(data, s->data, s->len);
        spi_device_exchange(s->device, data, s->len, 0);
    }
}
DECL_SHUTDOWN(spi_shutdown);
