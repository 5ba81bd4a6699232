/* Board contract: I2C by hardware.  Optional: a port without it leaves i2c_hardware.c out of its source list, and its
 * dictionary then has no i2c_set_bus (software I2C needs nothing but pins).
 *
 * port_types.h defines `struct i2c_bus` (small: it is copied): which peripheral, and the device's address.
 *
 *   i2c_bus_open      task context, before finalize_config; `bus` is the number the port gives it in its "i2c_bus"
 *                     enumeration, rate_hz the fastest clock allowed, `address` the seven bits without read/write.
 *                     Claims the pins.  Shuts down with SHUTDOWN_I2C_BUS or SHUTDOWN_I2C_SETUP.
 *   i2c_bus_exchange  task context: start, write write_len bytes, and if read_len is not 0 a repeated start and read_len
 *                     bytes; stop.  With write_len 0 there is only the reading half; with both 0 the address alone.
 *                     Never waits longer than some 5 ms in all; leaves the bus free also after a failure.
 *
 * The port also declares, for every bus, the constant BUS_PINS_<name> = "SCL,SDA" (pin names, in this order).
 */
#ifndef BOARD_I2C_H
#define BOARD_I2C_H

#include <stdint.h>

#include "board/i2c_status.h"
#include "port_types.h"

struct i2c_bus i2c_bus_open(uint32_t bus, uint32_t rate_hz, uint8_t address);
enum i2c_status i2c_bus_exchange(struct i2c_bus b, const uint8_t *write, uint8_t write_len, uint8_t *read,
                                 uint8_t read_len);

#endif
