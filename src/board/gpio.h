/* Board contract: digital pins.
 *
 * A pin is the number the port gives it in its "pin" enumeration.  port_types.h defines `struct gpio_out` and
 * `struct gpio_in` (small: they are copied), holding whatever makes read and write fast.
 *
 *   gpio_out_setup   task context; drives the pin to `value` without a glitch to the other level first;
 *                    shuts down with SHUTDOWN_NOT_OUTPUT_PIN on a pin that cannot
 *   gpio_out_write   any context, interrupts may be enabled or not; nothing on a struct of zeros (the DECL_SHUTDOWN function
 *                    of an object whose set-up has just shut down)
 *   gpio_out_toggle  the other level; in timer functions only, nothing interrupts it.  The inner loop of stepping, so it
 *                    should be a few instructions; port_types.h may define it inline, and PORT_INLINE_TOGGLE
 *   gpio_in_setup    pull: 1 pull-up, 0 none, -1 pull-down; shuts down with SHUTDOWN_NOT_INPUT_PIN
 *   gpio_in_read     0 or 1; any context
 *
 * A pin may be set up again, also as the other kind and from any context: lines that are driven low and let go (I2C,
 * single-wire UART).
 */
#ifndef BOARD_GPIO_H
#define BOARD_GPIO_H

#include <stdint.h>

#include "port_types.h"

struct gpio_out gpio_out_setup(uint32_t pin, uint8_t value);
void gpio_out_write(struct gpio_out g, uint8_t value);
#ifndef PORT_INLINE_TOGGLE
void gpio_out_toggle(struct gpio_out g);
#endif
struct gpio_in gpio_in_setup(uint32_t pin, int8_t pull);
uint8_t gpio_in_read(struct gpio_in g);

#endif
