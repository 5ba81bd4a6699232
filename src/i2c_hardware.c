/* I2C devices on a bus of the chip's own (board/i2c.h). */
#include "basecmd.h"
#include "board/i2c.h"
#include "command.h"
#include "i2ccmds.h"
#include "sched.h"

static enum i2c_status
hardware_exchange(void *bus, const uint8_t *write, uint8_t write_len, uint8_t *read, uint8_t read_len)
{
    return i2c_bus_exchange(*(struct i2c_bus *)bus, write, write_len, read, read_len);
}

void
command_i2c_set_bus(const struct command_args *args)
{
    struct i2c_device *d = i2c_device_lookup((uint8_t)args->val[0]);
    struct i2c_bus *bus = alloc_chunk(sizeof(*bus));
    if (args->val[3] > 0x7f)
        shutdown(SHUTDOWN_I2C_SETUP);
    *bus = i2c_bus_open(args->val[1], args->val[2], (uint8_t)args->val[3]);
    i2c_device_connect(d, hardware_exchange, bus);
}
DECL_COMMAND(command_i2c_set_bus, "i2c_set_bus oid=%c i2c_bus=%u rate=%u address=%u");
