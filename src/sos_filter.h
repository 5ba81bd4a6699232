/* A filter of second-order sections in fixed point; the host computes the coefficients.
 *
 *     raw ─► (raw - offset) · scale / 2^scale_frac_bits ─► section 0 ─► section 1 ... ─► value
 *
 *     section, transposed direct form II:   y = b0 x + s0     s0 = b1 x - a1 y + s1     s1 = b2 x - a2 y
 *
 * Coefficients b0 b1 b2 a1 a2 (a0 = 1) have coeff_frac_bits bits after the point, states and values are whole numbers: the
 * host chooses the scale so fine that one step does not matter. A value beyond 32 bits is an overflow, never a wrap.
 */
#ifndef SOS_FILTER_H
#define SOS_FILTER_H

#include <stdint.h>

struct sos_filter;

struct sos_filter *sos_filter_lookup(uint8_t oid);
/* With auto_offset the next sample becomes the offset. */
void sos_filter_reset(struct sos_filter *f);
/* Returns 0 if the value does not fit 32 bits. */
uint8_t sos_filter_apply(struct sos_filter *f, int32_t raw, int32_t *value);

#endif
