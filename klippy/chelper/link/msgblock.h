#ifndef CHELPER_MSGBLOCK_H
#define CHELPER_MSGBLOCK_H
// The wire's unit: one block.
//
//   offset   0     1            2 …          len-3      len-2     len-1
//          [len][0x10|sequence][content 0..59 bytes][crc high][crc low][0x7e]
//
// len counts the whole block (5..64). The CRC covers everything before it. 0x7e may occur inside a block; only the one
// where `len` says ends it.

#include <stdint.h>

enum {
    MSGBLOCK_MIN = 5,
    MSGBLOCK_MAX = 64,
    MSGBLOCK_HEAD = 2,
    MSGBLOCK_TAIL = 3,
    MSGBLOCK_SYNC = 0x7e,
    MSGBLOCK_SEQ_MASK = 0x0f,
    MSGBLOCK_DEST = 0x10,
};

uint16_t msgblock_crc(const uint8_t *data, int len); // CRC-16/MCRF4XX
// Frame `content_len` bytes into `out` (room for MSGBLOCK_MAX); returns the block's length.
int msgblock_build(uint8_t *out, uint64_t seq, const uint8_t *content, int content_len);
// Look at the first bytes of a stream that should begin with a block. > 0: a valid block of that length;
// 0: more bytes are needed; < 0: not a block, drop -result bytes and look again.
int msgblock_check(const uint8_t *data, int len);

#endif
