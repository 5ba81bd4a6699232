/* Sum, lowest and highest of a block of samples, taken in runs; the loop is the one thing that touches every sample: 12
 * instructions each in this portable form (Cortex-M4, -O2).  A port with dual 16-bit instructions is compiled with
 * -DPORT_OVERSAMPLE_KERNEL and supplies port_oversample.h with the same five functions over the same struct (stm32f334:
 * 2.5 instructions a sample); its results must be identical.  Samples may start at an odd index: a word-wise port takes
 * the odd one at each end by itself.
 *
 * `low` and `high` mean something to these functions only.  The sum does not overflow below 65537 samples.  Of no samples at
 * all the lowest is 65535 and the highest 0.
 */
#ifndef OVERSAMPLE_KERNEL_H
#define OVERSAMPLE_KERNEL_H

#include <stdint.h>

struct reduction {
    uint32_t sum, low, high;
};

#ifdef PORT_OVERSAMPLE_KERNEL
#include "port_oversample.h"
#else

static inline void
reduction_begin(struct reduction *r)
{
    *r = (struct reduction){0, UINT16_MAX, 0};
}

static inline void
reduction_add(struct reduction *r, const uint16_t *samples, uint16_t count)
{
    uint16_t low = (uint16_t)r->low, high = (uint16_t)r->high;
    uint32_t sum = r->sum;
    while (count--) {
        uint16_t s = *samples++;
        sum += s;
        low = s < low ? s : low;
        high = s > high ? s : high;
    }
    *r = (struct reduction){sum, low, high};
}

static inline uint16_t
reduction_min(const struct reduction *r)
{
    return (uint16_t)r->low;
}

static inline uint16_t
reduction_max(const struct reduction *r)
{
    return (uint16_t)r->high;
}

#endif
#endif
