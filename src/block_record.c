/* Format: block_record.h. */
#include "block_record.h"

enum {
    SAMPLE_MASK = 0x0fff,
    RECORD_PHASE = 0x1000,
    RECORD_CUT = 0x2000,
    RECORD_GAP = 0x4000,
    RECORD_WIDE = 0x8000,
    WIDE_SPAN = 255,
};

static uint8_t *
put_u16(uint8_t *p, uint16_t v)
{
    *p++ = (uint8_t)v;
    *p++ = (uint8_t)(v >> 8);
    return p;
}

uint8_t *
block_record_put(uint8_t *p, const struct oversample_block *b, const struct oversample_block *before,
                 uint16_t block_len)
{
    uint16_t span = b->max - b->min, flags = 0;
    flags |= !before || before->phase != b->phase ? RECORD_PHASE : 0;
    flags |= b->count != block_len ? RECORD_CUT : 0;
    flags |= b->discarded || b->lost ? RECORD_GAP : 0;
    flags |= span >= WIDE_SPAN ? RECORD_WIDE : 0;
    p = put_u16(p, (b->min & SAMPLE_MASK) | flags);
    *p++ = flags & RECORD_WIDE ? WIDE_SPAN : (uint8_t)span;
    p = put_u16(p, (uint16_t)b->value);
    *p++ = (uint8_t)(b->value >> 16);
    if (flags & RECORD_PHASE)
        p = put_u16(p, b->phase);
    if (flags & RECORD_CUT)
        p = put_u16(p, b->count);
    if (flags & RECORD_GAP)
        p = put_u16(put_u16(p, b->discarded), b->lost);
    return flags & RECORD_WIDE ? put_u16(p, b->max) : p;
}
