/* The wire format: checksum and number encoding.  Pure: no board, no state.
 *
 * A message block, both directions (Klipper's Protocol.md):
 *
 *     +-----+----------+-------------------+---------------+------+
 *     | len | 0x10|seq | content 0..59     | crc hi, lo    | 0x7e |
 *     +-----+----------+-------------------+---------------+------+
 *       \____________ crc over these ______/
 *
 * `len` counts the whole block (5..64).  `seq` is four bits.  0x7e is not escaped in the content, so it
 * marks a block's end only at the place `len` says.
 */
#ifndef WIRE_H
#define WIRE_H

#include <stdint.h>

enum {
    BLOCK_HEADER_SIZE = 2,
    BLOCK_TRAILER_SIZE = 3,
    BLOCK_SIZE_MIN = BLOCK_HEADER_SIZE + BLOCK_TRAILER_SIZE,
    BLOCK_SIZE_MAX = 64,
    BLOCK_CONTENT_MAX = BLOCK_SIZE_MAX - BLOCK_SIZE_MIN,
    BLOCK_SYNC = 0x7e,
    BLOCK_SEQ_MARK = 0x10,  /* the high nibble every sequence byte must have */
    BLOCK_SEQ_MASK = 0x0f,
    VLQ_SIZE_MAX = 5,
};

/* CRC-16/MCRF4XX (reflected CCITT polynomial, start 0xffff, no final xor); "123456789" gives 0x6f91.
 * A port whose chip computes it defines PORT_WIRE_CRC16 and supplies this function; task context then. */
uint16_t wire_crc16(const uint8_t *data, uint8_t len);

/* Write `value` as a variable length quantity, most significant seven bits first.  Returns one past the last
 * byte written (1..VLQ_SIZE_MAX bytes).  Unsigned numbers are passed as their 32-bit pattern. */
uint8_t *wire_put_vlq(uint8_t *out, int32_t value);

/* Read one quantity from [at, end).  Returns one past its last byte, or NULL if it runs over `end` or is longer
 * than any 32-bit number needs. */
const uint8_t *wire_get_vlq(const uint8_t *at, const uint8_t *end, int32_t *value);

/* Close the block whose `content_len` bytes already stand at block + BLOCK_HEADER_SIZE: header, checksum, sync.
 * Returns the block's length. */
uint8_t wire_seal_block(uint8_t *block, uint8_t content_len, uint8_t sequence);

#endif
