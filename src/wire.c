#include <stddef.h>

#include "port_types.h"
#include "wire.h"

#ifdef __AVR__
#include <util/crc16.h>
#endif

#ifndef PORT_WIRE_CRC16
uint16_t
wire_crc16(const uint8_t *data, uint8_t len)
{
    uint16_t crc = 0xffff;
    for (; len; len--, data++) {
#ifdef __AVR__
        crc = _crc_ccitt_update(crc, *data); /* the same polynomial, in assembler */
#else
        /* All eight shifts of the polynomial 0x8408 at once: its bits lie so far apart that what a byte feeds back is
         * itself folded once (t) and then placed at the three places of the polynomial. */
        uint32_t t = (crc ^ *data) & 0xffu;
        t = (t ^ t << 4) & 0xffu;
        crc = (uint16_t)(crc >> 8 ^ t << 8 ^ t << 3 ^ t >> 4);
#endif
    }
    return crc;
}
#endif

/* How many seven-bit groups a number needs: it fits n groups when what is left of it after dropping the n-1 lower
 * groups lies in -32..95, because a first group of 0x60..0x7f reads as negative. */
static uint8_t
vlq_groups(int32_t value)
{
    uint8_t groups = 1;
    while (groups < VLQ_SIZE_MAX && (value < -32 || value > 95)) {
        value >>= 7;
        groups++;
    }
    return groups;
}

uint8_t *
wire_put_vlq(uint8_t *out, int32_t value)
{
    for (uint8_t left = vlq_groups(value); left > 1; left--)
        *out++ = (uint8_t)(value >> (7 * (left - 1))) | 0x80;
    *out++ = (uint8_t)value & 0x7f;
    return out;
}

const uint8_t *
wire_get_vlq(const uint8_t *at, const uint8_t *end, int32_t *value)
{
    if (at >= end)
        return NULL;
    uint8_t byte = *at++;
    uint32_t sum = (byte & 0x60) == 0x60 ? ~(uint32_t)0x7f | byte : byte & 0x7f;
    for (uint8_t more = VLQ_SIZE_MAX - 1; byte & 0x80; more--) {
        if (!more || at >= end)
            return NULL;
        byte = *at++;
        sum = sum << 7 | (byte & 0x7f);
    }
    *value = (int32_t)sum;
    return at;
}

uint8_t
wire_seal_block(uint8_t *block, uint8_t content_len, uint8_t sequence)
{
    uint8_t checked_len = BLOCK_HEADER_SIZE + content_len;
    block[0] = checked_len + BLOCK_TRAILER_SIZE;
    block[1] = BLOCK_SEQ_MARK | (sequence & BLOCK_SEQ_MASK);
    uint16_t crc = wire_crc16(block, checked_len);
    block[checked_len] = (uint8_t)(crc >> 8);
    block[checked_len + 1] = (uint8_t)crc;
    block[checked_len + 2] = BLOCK_SYNC;
    return block[0];
}
