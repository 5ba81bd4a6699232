// Blocks of the wire protocol: checksum, framing, recognition. See msgblock.h for the layout.

#include "msgblock.h"
#include <string.h>

// One row for each value of the low nibble of (crc ^ data): the reflected polynomial 0x8408 applied four times.
static const uint16_t crc_nibble[16] = {
    0x0000, 0x1081, 0x2102, 0x3183, 0x4204, 0x5285, 0x6306, 0x7387,
    0x8408, 0x9489, 0xa50a, 0xb58b, 0xc60c, 0xd68d, 0xe70e, 0xf78f,
};

uint16_t
msgblock_crc(const uint8_t *data, int len)
{
    uint16_t crc = 0xffff;
    for (int i = 0; i < len; i++) {
        crc = (uint16_t)((crc >> 4) ^ crc_nibble[(crc ^ data[i]) & 0x0f]);
        crc = (uint16_t)((crc >> 4) ^ crc_nibble[(crc ^ (data[i] >> 4)) & 0x0f]);
    }
    return crc;
}

int
msgblock_build(uint8_t *out, uint64_t seq, const uint8_t *content, int content_len)
{
    int len = MSGBLOCK_HEAD + content_len + MSGBLOCK_TAIL;
    out[0] = (uint8_t)len;
    out[1] = (uint8_t)(MSGBLOCK_DEST | (seq & MSGBLOCK_SEQ_MASK));
    if (content_len)
        memcpy(out + MSGBLOCK_HEAD, content, (size_t)content_len);
    uint16_t crc = msgblock_crc(out, len - MSGBLOCK_TAIL);
    out[len - 3] = (uint8_t)(crc >> 8);
    out[len - 2] = (uint8_t)crc;
    out[len - 1] = MSGBLOCK_SYNC;
    return len;
}

// Bytes up to and including the next sync, from which a block may begin again.
static int
bytes_to_resync(const uint8_t *data, int len)
{
    const uint8_t *sync = memchr(data, MSGBLOCK_SYNC, (size_t)len);
    return sync ? (int)(sync - data) + 1 : len;
}

int
msgblock_check(const uint8_t *data, int len)
{
    if (!len)
        return 0;
    if (data[0] == MSGBLOCK_SYNC)
        return -1;
    int block_len = data[0];
    if (block_len < MSGBLOCK_MIN || block_len > MSGBLOCK_MAX)
        return -bytes_to_resync(data, len);
    if (len >= 2 && (data[1] & ~MSGBLOCK_SEQ_MASK) != MSGBLOCK_DEST)
        return -bytes_to_resync(data, len);
    if (len < block_len)
        return 0;
    uint16_t crc = (uint16_t)(data[block_len - 3] << 8 | data[block_len - 2]);
    if (data[block_len - 1] != MSGBLOCK_SYNC || crc != msgblock_crc(data, block_len - MSGBLOCK_TAIL))
        return -bytes_to_resync(data, len);
    return block_len;
}
