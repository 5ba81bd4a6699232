/* Board contract: the rest.
 *
 *   board_arena   the memory left for objects and the move queue: its start (aligned for a pointer) in *start, returns
 *                 its size in bytes.  Asked once at boot.
 *   board_reset   restart the chip as after power-on.  Any context.  May return (the simulator's does: the world outside
 *                 boots it again); the caller must then do nothing more.
 *   board_peek, board_poke   debug_read and debug_write: an access of 1 << order bytes.
 *
 * Besides functions, a port's port_types.h defines
 *
 *   PORT_CLOCK_HZ        timer ticks a second
 *   PORT_MOVE_COUNT_MAX  upper limit of the move queue (memory allowing)
 *
 * and one of its source files declares the constants MCU, CLOCK_FREQ, ADC_MAX, PWM_MAX, SERIAL_BAUD and RECEIVE_WINDOW
 * (serial ports), RESERVE_PINS_*, and the enumeration "pin".
 */
#ifndef BOARD_MISC_H
#define BOARD_MISC_H

#include <stddef.h>
#include <stdint.h>

size_t board_arena(void **start);
void board_reset(void);
uint32_t board_peek(uint8_t order, uint32_t address);
void board_poke(uint8_t order, uint32_t address, uint32_t value);

#endif
