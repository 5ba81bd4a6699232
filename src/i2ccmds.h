/* Devices on an I2C bus; the bits by a transport (i2c_hardware.c, i2c_software.c). */
#ifndef I2CCMDS_H
#define I2CCMDS_H

#include <stdint.h>

#include "board/i2c_status.h"

struct i2c_device;

/* As i2c_bus_exchange() of board/i2c.h; `bus` is the transport's own memory and knows the address. */
typedef enum i2c_status (*i2c_exchange_fn)(void *bus, const uint8_t *write, uint8_t write_len, uint8_t *read,
                                           uint8_t read_len);

struct i2c_device *i2c_device_lookup(uint8_t oid);
void i2c_device_connect(struct i2c_device *d, i2c_exchange_fn exchange, void *bus);
/* Task context. */
enum i2c_status i2c_device_exchange(struct i2c_device *d, const uint8_t *write, uint8_t write_len, uint8_t *read,
                                    uint8_t read_len);

#endif
