#ifndef CHELPER_BLOCKWIRE_H
#define CHELPER_BLOCKWIRE_H
// Raw `induction_block` messages to blocks. The layout of a record: klippy/thermal/sensing/convert.py.

#include <stdint.h>

struct coil_block;
struct pull_message;

enum { BLOCKS_MAX = 256, MESSAGE_BLOCKS_MAX = 8 }; // a message has room for 48 bytes of records of 6 at least

enum blockwire_error { BLOCKWIRE_CUT = 1, BLOCKWIRE_SENSELESS = 2, BLOCKWIRE_EMPTY = 3 };

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
    int64_t senseless_messages;     // ignored, and what was wrong with the newest of them: enum blockwire_error
    int32_t complaint;
};

// A clock nearer than 2^31 ticks to those of the messages, its print time, and that of a tick around it.
struct clock_point {
    int64_t clock;
    double time_s, tick_s;
};

// Unpack messages as they came off the wire into `out` (BLOCKS_MAX, what does not fit counts as missing); one seen before
// gives nothing. Number of blocks.
int blockwire_unpack(struct block_stream *stream, const struct clock_point *near, const struct pull_message *messages,
                     int message_count, struct coil_block *out);

#endif
