/* Board contract: the wave of a LED chain (WS2812, SK6812), by a port that knows its instructions' time.  Optional.
 *
 * neopixel.c makes the wave itself from gpio_out_write() and delay_ticks().  A port where a look at the clock takes longer
 * than a bit defines PORT_LED_CHAIN in port_types.h and supplies
 *
 *   led_send   task context, the line low: `size` bytes, highest bit first; a bit's high part 250 to 450 ns for a 0, 650 to
 *              750 ns for a 1, low for 450 ns at least.  Interrupts are off in the high part only.  Returns 0 as soon as
 *              the line has been low for bit_max_ticks between two bits: the LEDs may have taken that for the end.
 */
#ifndef BOARD_LED_H
#define BOARD_LED_H

#include <stdint.h>

#include "port_types.h"

#ifdef PORT_LED_CHAIN
uint8_t led_send(struct gpio_out pin, const uint8_t *data, uint16_t size, uint32_t bit_max_ticks);
#endif

#endif
