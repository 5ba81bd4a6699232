/* Do blocks still read what the host expects?  While nothing happens a host knows beforehand what a block will read; it
 * need then not be woken for each, if somebody watches that it stays so ("send on delta": Miskowicz 2006, Sensors 6(1), 49).
 * Pure: no board; blocks come in, "tell the host" comes out.
 *
 *     mean += (sum - expected - mean) / 8        over whole blocks whose phase something is expected for
 *     strayed when |mean| > limit, or at once when |sum - expected| > 8 limit
 *
 * An exponentially weighted mean (Lucas and Saccucci 1990, Technometrics 32(1), 1): its noise is sqrt(1/15) = 0.26 of a
 * block's, so the limit may be near.  It begins at 0: what is expected is what was measured.
 * A step of the phase moves the reading.  What is expected is told before the step comes, so the expectation before is kept
 * until the first block of the new phase.  Blocks of any other phase, and cut ones, are not judged.
 * Straying is told once; then nothing is expected until told again.
 * Formats: sums of whole blocks, < 2^30; limit <= ATTENTION_LIMIT_MAX, so 8 times the mean stays below 2^29.
 * Contexts: attention_block in the ADC's interrupt, once a whole block, about 30 cycles; the other in tasks with interrupts
 * disabled.
 */
#ifndef ATTENTION_H
#define ATTENTION_H

#include <stdint.h>

#define ATTENTION_LIMIT_MAX (1ul << 24)

struct attention_expected {
    uint32_t sum;
    uint16_t phase;
};

struct attention {
    struct attention_expected now, next;
    uint32_t limit; /* 0: nothing is expected */
    int32_t mean8;  /* 8 times the mean */
};

/* From the next step to `phase` on (at once, if it is in force) whole blocks are expected to have this sum.  limit 0: nothing
 * is expected any more. */
void attention_expect(struct attention *a, uint16_t phase, uint32_t sum, uint32_t limit);
/* A whole block.  1 if it and those before stray from what is expected. */
uint8_t attention_block(struct attention *a, uint16_t phase, uint32_t sum);

#endif
