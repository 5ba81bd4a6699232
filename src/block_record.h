/* A block of samples as bytes of a message (induction_block).  Pure.
 *
 * A record, little endian, the optional parts in this order:
 *
 *     u16 bits 0-11 lowest sample, bits 12-15 flags · u8 highest - lowest · u24 value
 *     PHASE u16 phase (else as in the record before; always in a message's first)
 *     CUT   u16 count (else block_len)
 *     GAP   u16 discarded · u16 lost (else 0)
 *     WIDE  u16 highest sample (the u8 is then 255)
 *
 * 6 bytes for a whole block under an unchanged phase, 16 at most.  The message's clock is that of its first record's first
 * sample; the next record's lies count periods on, and discarded + lost more, because every sample is accounted for.  Only
 * where those two saturate that would not hold: such a record begins a message.
 */
#ifndef BLOCK_RECORD_H
#define BLOCK_RECORD_H

#include <stdint.h>

#include "oversample.h"

enum { BLOCK_RECORD_MAX = 16 };

/* Writes at p, returns the end.  `before` is the record before in the same message, or NULL. */
uint8_t *block_record_put(uint8_t *p, const struct oversample_block *b, const struct oversample_block *before,
                          uint16_t block_len);

#endif
