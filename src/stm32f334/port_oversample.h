/* The two loops over every sample, with the Cortex-M4's instructions on pairs of 16-bit numbers.
 *
 *   SMLAD   sum += low * 1 + high * 1: two samples an instruction (they are signed, so samples lie below 32768: 12 bits do)
 *   USUB16, SEL   two minima, two maxima: USUB16 leaves in the flags which halves are smaller, SEL chooses by them
 *
 * Of four samples in two words the pairwise lesser and greater ones are found first (3 instructions), then only these meet the
 * minimum and the maximum (2 + 2): 7 for four samples instead of 8.
 *
 * Results are those of src/oversample_kernel.h.  Samples may start at an odd index.
 */
#ifndef PORT_OVERSAMPLE_H
#define PORT_OVERSAMPLE_H

#include <stdint.h>

static inline uint32_t
pair_sum(uint32_t pair, uint32_t sum)
{
    __asm__("smlad %0, %1, %2, %0" : "+r"(sum) : "r"(pair), "r"(0x00010001u));
    return sum;
}

/* The lesser halves of two pairs in *less, the greater ones in *more. */
static inline void
pair_order(uint32_t a, uint32_t b, uint32_t *less, uint32_t *more)
{
    uint32_t low, high, unused;
    __asm__("usub16 %2, %3, %4\n\tsel %0, %4, %3\n\tsel %1, %3, %4"
            : "=&r"(low), "=&r"(high), "=&r"(unused)
            : "r"(a), "r"(b));
    *less = low;
    *more = high;
}

static inline uint32_t
pair_min(uint32_t a, uint32_t b)
{
    uint32_t out;
    __asm__("usub16 %0, %1, %2\n\tsel %0, %2, %1" : "=&r"(out) : "r"(a), "r"(b));
    return out;
}

static inline uint32_t
pair_max(uint32_t a, uint32_t b)
{
    uint32_t out;
    __asm__("usub16 %0, %1, %2\n\tsel %0, %1, %2" : "=&r"(out) : "r"(a), "r"(b));
    return out;
}

static inline uint32_t
oversample_sum(const uint16_t *samples, uint16_t count)
{
    uint32_t sum = 0;
    if ((uintptr_t)samples & 2u && count) {
        sum = *samples++;
        count--;
    }
    const uint32_t *pairs = (const uint32_t *)(const void *)samples;
    for (; count >= 16; count -= 16, pairs += 8)
        for (unsigned i = 0; i < 8; i++)
            sum = pair_sum(pairs[i], sum);
    for (; count >= 2; count -= 2)
        sum = pair_sum(*pairs++, sum);
    return count ? sum + *(const uint16_t *)(const void *)pairs : sum;
}

static inline void
oversample_range(const uint16_t *samples, uint16_t count, uint16_t *min, uint16_t *max)
{
    uint32_t low = *min | (uint32_t)*min << 16, high = *max | (uint32_t)*max << 16;
    if ((uintptr_t)samples & 2u && count) {
        uint32_t one = *samples++;
        low = pair_min(low, one | 0xffff0000u);
        high = pair_max(high, one);
        count--;
    }
    const uint32_t *pairs = (const uint32_t *)(const void *)samples;
    for (; count >= 4; count -= 4, pairs += 2) {
        uint32_t less, more;
        pair_order(pairs[0], pairs[1], &less, &more);
        low = pair_min(low, less);
        high = pair_max(high, more);
    }
    for (; count; count--) {
        uint32_t one = *(const uint16_t *)(const void *)pairs;
        low = pair_min(low, one | 0xffff0000u);
        high = pair_max(high, one);
        pairs = (const uint32_t *)(const void *)((const uint16_t *)(const void *)pairs + 1);
    }
    low = pair_min(low, low >> 16 | low << 16);
    high = pair_max(high, high >> 16 | high << 16);
    *min = (uint16_t)low;
    *max = (uint16_t)high;
}

#endif
