#ifndef CHELPER_BLOCKWIRE_H
#define CHELPER_BLOCKWIRE_H
// Raw `induction_block` messages to blocks. The layout of a record: klippy/thermal/convert.py.

#include <stdint.h>

struct coil_block;

enum { BLOCKS_MOST = 16 }; // a message holds 59 bytes, a record 6 at least

enum blockwire_error { BLOCKWIRE_CUT = -1, BLOCKWIRE_SENSELESS = -2, BLOCKWIRE_EMPTY = -3 };

// One MCU's stream of blocks.
struct block_stream {
    int64_t period_ticks;           // bridge period
    double period_s;
    int32_t oversample;             // y: a sum comes divided by 2^y
    int32_t block_samples;          // samples of a whole block
    // counted
    int64_t next_sequence;          // unwrapped index expected next; -1 before the first message
    int64_t blocks;
    int64_t missing_blocks;         // never arrived: gaps in the sequence
    int64_t lost_samples;           // overwritten on the MCU
    int64_t discarded_samples;
};

// Unpack one message into `out` (BLOCKS_MOST); `clock` is its clock extended to 64 bit, `start_s` that as print time.
// Number of blocks, 0 for a message seen before, or one of blockwire_error: then nothing has changed.
int blockwire_unpack(struct block_stream *stream, struct coil_block *out, uint32_t sequence, int64_t clock,
                     double start_s, const uint8_t *data, int len);

#endif
