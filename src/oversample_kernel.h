/* The loop that touches every sample: 12 instructions a sample in this portable form (Cortex-M4, -O2).  A port with dual
 * 16-bit instructions is compiled with -DPORT_OVERSAMPLE_KERNEL and supplies port_oversample.h with the same function
 * (stm32f334: 2.5 instructions a sample); its results must be identical.  Samples may start at an odd index: a
 * word-wise port takes the odd one at each end by itself.
 *
 *   oversample_reduce   returns the sum, u32, no overflow below 65537 samples; widens *min and *max
 */
#ifndef OVERSAMPLE_KERNEL_H
#define OVERSAMPLE_KERNEL_H

#include <stdint.h>

#ifdef PORT_OVERSAMPLE_KERNEL
#include "port_oversample.h"
#else

static inline uint32_t
oversample_reduce(const uint16_t *samples, uint16_t count, uint16_t *min, uint16_t *max)
{
    uint16_t low = *min, high = *max;
    uint32_t sum = 0;
    while (count--) {
        uint16_t s = *samples++;
        sum += s;
        low = s < low ? s : low;
        high = s > high ? s : high;
    }
    *min = low;
    *max = high;
    return sum;
}

#endif
#endif
