/* Block sums of the fast ADC: 4^y samples give y more bits (Oskolkov 2021, eq 2; y = 5: 12 -> 17 bit).
 * Shorter blocks than that are for a host that filters in temperature: 192 samples come every 1.6 ms.
 * Pure: no board, no clock; samples and their phase come in, blocks go out.
 *
 *     phase      ......11111111111111111111111111111111111111112222222222222222222222222
 *     samples          |settling|  block: block_len      | next, cut |settling| block ...
 *                       discarded                          ^ a phase step ends a block early
 *
 * A block ends at block_len samples (4^y unless configured otherwise), at a phase step or at a gap in the samples, so one block
 * has one phase and no hole.  A block that was cut carries its count; cut below block_len/16 samples it is not worth a message and its samples count as
 * discarded.  The EMA (filters.h) runs over whole blocks of one phase: it restarts at a phase step and at a gap, because
 * the value's meaning changes with the phase; a cut block is reported unfiltered and does not enter it (its scale
 * differs, and putting that right would take a division).
 *
 * Every sample is accounted for, always:  fed + lost = sum over blocks of (count + discarded + lost) + what is held.
 *
 * Formats: samples u16; sum u32, no overflow for y <= OVERSAMPLE_Y_MAX (65535 * 4^7 < 2^30); value = sum >> y, rounded
 * down, u23.  discarded and lost saturate at 65535.  Sample indices run modulo 2^32.
 *
 * Contexts: oversample_feed is called from the ADC's interrupt, once per run of one phase (1 to a few per half buffer).
 * Cost: reduction_add over the run plus about 60 cycles per run; no division.
 */
#ifndef OVERSAMPLE_H
#define OVERSAMPLE_H

#include <stdint.h>

#include "filters.h"
#include "oversample_kernel.h"

enum { OVERSAMPLE_Y_MIN = 3, OVERSAMPLE_Y_MAX = 7, OVERSAMPLE_CUT_SHIFT = 4 /* shortest cut block: block_len / 16 */ };

struct oversample_config {
    uint8_t y;
    uint8_t ema_shift;        /* 0 = no filter */
    uint16_t settle_samples;  /* discarded after a phase step */
    uint16_t block_len;       /* 4^(y-2) ..= 4^y; 0 = 4^y */
};

/* A finished block. */
struct oversample_block {
    uint32_t first;      /* index of its first sample */
    uint32_t value;      /* sum >> y, or the EMA of that */
    uint32_t sum;        /* unfiltered, for the guard */
    uint16_t count;
    uint16_t phase;
    uint16_t min, max;
    uint16_t discarded, lost; /* since the block before: samples neither summed nor lost; samples never seen */
};

struct oversample {
    struct oversample_config config;
    uint16_t block_len, cut_len;
    /* the block being summed */
    struct reduction reduction;
    uint32_t first;
    uint16_t count;
    /* between blocks */
    uint16_t phase, settle_left, discarded, lost;
    struct ema ema;
};

/* Returns 0 if the configuration is out of range (nothing is changed), 1 if good. */
uint8_t oversample_init(struct oversample *o, struct oversample_config config);

/* Each of these four may finish a block: it is then in *block and 1 is returned. */

/* From the next sample on this phase holds.  The same phase again is no step. */
uint8_t oversample_step(struct oversample *o, uint16_t phase, struct oversample_block *block);
/* `count` samples were overwritten before they could be read. */
uint8_t oversample_gap(struct oversample *o, uint32_t count, struct oversample_block *block);
/* `count` samples are no reading (signal_test.h): a block ends before them. */
uint8_t oversample_skip(struct oversample *o, uint16_t count, struct oversample_block *block);
/* Take samples[0] (index `first`) and as many after it as end at most one block; *taken says how many.  Call again with
 * the rest. */
uint8_t oversample_feed(struct oversample *o, const uint16_t *samples, uint16_t count, uint32_t first, uint16_t *taken,
                        struct oversample_block *block);
/* A finished block could not be kept: its samples are reported as lost with the next. */
void oversample_drop(struct oversample *o, const struct oversample_block *block);

#endif
