/* Board contract: the byte stream to the host (UART, USB, CAN frames, a pty).
 *
 *   console_read   the next received byte, 1 if there was one, 0 if not.  Task context.  The port keeps at least
 *                  RECEIVE_WINDOW bytes (the constant it exports): the host never has more than that unacknowledged.
 *                  Bytes beyond are dropped; the protocol's checksum and sequence notice.  The receive interrupt calls
 *                  command_wake().
 *   console_send   queue one whole block (at most 64 bytes) for transmission and return at once.  Task context.
 *                  With no room for all of it, drop all of it.
 */
#ifndef BOARD_CONSOLE_H
#define BOARD_CONSOLE_H

#include <stdint.h>

uint8_t console_read(uint8_t *byte);
void console_send(const uint8_t *block, uint8_t len);

#endif
