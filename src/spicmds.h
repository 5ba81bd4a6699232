/* Devices on an SPI bus: chip select here, the bits by a transport (spi_hardware.c, spi_software.c). */
#ifndef SPICMDS_H
#define SPICMDS_H

#include <stdint.h>

struct spi_device;

/* How bits reach the device.  `bus` is the transport's own memory, given to spi_device_connect(). */
struct spi_transport {
    void (*prepare)(void *bus);  /* mode and rate in force, clock line at its idle level; before the chip select */
    void (*exchange)(void *bus, uint8_t *data, uint8_t len, uint8_t keep_reply);
};

struct spi_device *spi_device_lookup(uint8_t oid);
void spi_device_connect(struct spi_device *d, const struct spi_transport *transport, void *bus);

/* Task context: one transfer of len bytes with the chip selected; the reply takes the place of `data` if keep_reply. */
void spi_device_exchange(struct spi_device *d, uint8_t *data, uint8_t len, uint8_t keep_reply);

#endif
