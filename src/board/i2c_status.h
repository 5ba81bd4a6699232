/* How an I2C transfer ended; the host gets it by name (enumeration i2c_bus_status). */
#ifndef BOARD_I2C_STATUS_H
#define BOARD_I2C_STATUS_H

enum i2c_status {
    I2C_SUCCESS,
    I2C_NACK,             /* a data byte was not acknowledged */
    I2C_TIMEOUT,          /* the clock line was held low too long, or the bus never became free */
    I2C_START_NACK,       /* no device answers to the address */
    I2C_START_READ_NACK,  /* no device answers to the address in the reading half */
};

#endif
