/* Exponential moving average in fixed point.  Pure: no board, no clock, no memory of its own.
 *
 *     y += (x - y) / 2^shift            Oskolkov 2021, eqs 3 and 4 with alpha = 2^-shift
 *
 * Formats: input and output u23.0 (0 ..= EMA_INPUT_MAX), state u23.8.  No step can overflow: the state stays between
 * the smallest and largest input so far, so a difference of two states is at most 2^31 - 256. Rounding adds no
 * more than 2^(EMA_SHIFT_MAX - 1) = 128 to it.
 * Rounding: half up, at each step and at the output; the state stops within 2^(shift-1)/256 of a constant input.
 * Cost: a subtraction, two additions, two shifts; no division.
 */
#ifndef FILTERS_H
#define FILTERS_H

#include <stdint.h>

#define EMA_INPUT_MAX ((UINT32_C(1) << 23) - 1)

enum { EMA_SHIFT_MAX = 8, EMA_FRACTION_BITS = 8 };

struct ema {
    int32_t state; /* u23.8 held in a signed word; bit 31 stays 0 */
    uint8_t shift; /* 0 = pass through */
    uint8_t primed;
};

void ema_init(struct ema *f, uint8_t shift);
/* The next input becomes the state: after a gap or where old values say nothing about new ones. */
void ema_restart(struct ema *f);
uint32_t ema_update(struct ema *f, uint32_t input);

#endif
