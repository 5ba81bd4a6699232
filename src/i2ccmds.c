/* Commands for devices on an I2C bus.  config_i2c makes a device, i2c_set_bus or i2c_set_sw_bus connects it; i2c_transfer
 * writes and reads in one go and answers how it went, so a missing device is the host's to judge, no reason to shut down. */
#include "i2ccmds.h"

#include <string.h>

#include "basecmd.h"
#include "command.h"
#include "sched.h"

DECL_RESPONSE(response_i2c, "i2c_response oid=%c i2c_bus_status=%c response=%*s");
DECL_ENUMERATION("i2c_bus_status", "SUCCESS", I2C_SUCCESS);
DECL_ENUMERATION("i2c_bus_status", "NACK", I2C_NACK);
DECL_ENUMERATION("i2c_bus_status", "TIMEOUT", I2C_TIMEOUT);
DECL_ENUMERATION("i2c_bus_status", "START_NACK", I2C_START_NACK);
DECL_ENUMERATION("i2c_bus_status", "START_READ_NACK", I2C_START_READ_NACK);

enum { I2C_READ_MAX = 54 };  /* 59 bytes of content less id, oid, status and length */

struct i2c_device {
    i2c_exchange_fn exchange;  /* NULL: not connected yet */
    void *bus;
};

void
command_config_i2c(const struct command_args *args)
{
    oid_alloc((uint8_t)args->val[0], command_config_i2c, sizeof(struct i2c_device));
}
DECL_COMMAND(command_config_i2c, "config_i2c oid=%c");

struct i2c_device *
i2c_device_lookup(uint8_t oid)
{
    return oid_lookup(oid, command_config_i2c);
}

void
i2c_device_connect(struct i2c_device *d, i2c_exchange_fn exchange, void *bus)
{
    d->bus = bus;
    d->exchange = exchange;
}

enum i2c_status
i2c_device_exchange(struct i2c_device *d, const uint8_t *write, uint8_t write_len, uint8_t *read, uint8_t read_len)
{
    if (!d->exchange)
        shutdown(SHUTDOWN_I2C_SETUP);
    return d->exchange(d->bus, write, write_len, read, read_len);
}

void
command_i2c_transfer(const struct command_args *args)
{
    uint8_t oid = (uint8_t)args->val[0];
    struct i2c_device *d = i2c_device_lookup(oid);
    uint8_t read[I2C_READ_MAX];
    if (args->val[1] > sizeof(read))
        shutdown(SHUTDOWN_I2C_SETUP);
    uint8_t read_len = (uint8_t)args->val[1];
    memset(read, 0, sizeof(read));
    enum i2c_status status = i2c_device_exchange(d, args->data, args->data_len, read, read_len);
    respond(&response_i2c, oid, status, (unsigned int)(status == I2C_SUCCESS ? read_len : 0), read);
}
DECL_COMMAND(command_i2c_transfer, "i2c_transfer oid=%c write=%*s read_len=%u");
