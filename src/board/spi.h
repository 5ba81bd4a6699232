/* Board contract: SPI by hardware.  Optional: a port without it leaves spi_hardware.c out of its source list, and its
 * dictionary then has no spi_set_bus (software SPI needs nothing but pins).
 *
 * port_types.h defines `struct spi_bus` (small: it is copied): which peripheral, with what mode and clock divider.
 * Several devices share one peripheral, each with its own struct, so the settings go into the hardware each time.
 *
 *   spi_bus_open      task context, before finalize_config; `bus` is the number the port gives it in its "spi_bus"
 *                     enumeration, mode 0..3 (CPOL * 2 + CPHA), the clock is the fastest not above rate_hz.  Claims the
 *                     pins.  Shuts down with SHUTDOWN_SPI_BUS or SHUTDOWN_SPI_SETUP.
 *   spi_bus_prepare   task context: load mode and rate; the clock line is at its idle level when this returns.  Called
 *                     before the chip select, which is not the port's affair.
 *   spi_bus_exchange  task context: len bytes out of `data`, most significant bit first; what came in takes their place
 *                     if keep_reply is set (without it the port may skip reading).  Returns when the last bit is over.
 *
 * Task context means that nothing else uses the bus meanwhile; timers and interrupts may come between bytes.  DECL_SHUTDOWN
 * functions call prepare and exchange with interrupts disabled, possibly in the middle of another exchange, which is
 * then finished but worthless.
 *
 * The port also declares, for every bus, the constant BUS_PINS_<name> = "MISO,MOSI,SCLK" (pin names, in this order).
 */
#ifndef BOARD_SPI_H
#define BOARD_SPI_H

#include <stdint.h>

#include "port_types.h"

struct spi_bus spi_bus_open(uint32_t bus, uint8_t mode, uint32_t rate_hz);
void spi_bus_prepare(struct spi_bus b);
void spi_bus_exchange(struct spi_bus b, uint8_t *data, uint8_t len, uint8_t keep_reply);

#endif
