/* The loop over every sample, with the Cortex-M4's instructions on pairs of 16-bit numbers.
 *
 *   SMLAD         sum += low * 1 + high * 1: two samples an instruction (they are signed, so samples lie below 32768: 12 bits do)
 *   USUB16, SEL   USUB16 leaves in the flags which half of a word is smaller, SEL chooses by them: two minima or maxima
 *
 * Of four samples in two words the lesser and the greater ones are found first (3 instructions), then only these meet
 * the minimum and the maximum (2 + 2): 7 for four samples where 8 would be the obvious way.  With loads and the loop,
 * 154 instructions for 64 samples: 2.4 each.
 *
 * The result is that of src/oversample_kernel.h.  Samples may start at an odd index.
 */
#ifndef PORT_OVERSAMPLE_H
#define PORT_OVERSAMPLE_H

#include <stdint.h>

/* low and high of a struct reduction are two each: of the even and of the odd samples. */

static inline void
pair_single(struct reduction *s, uint32_t sample)
{
    uint32_t other = sample | 0xffff0000u;
    __asm__("usub16 %2, %0, %3\n\tsel %0, %3, %0\n\tusub16 %2, %1, %4\n\tsel %1, %1, %4"
            : "+r"(s->low), "+r"(s->high), "=&r"(other)
            : "r"(other), "r"(sample));
    s->sum += sample;
}

#define PAIRS_OF_EIGHT                                                                      \
    "ldmia %[at]!, {r4, r5, r6, r8}\n\t"                                                    \
    "smlad %[sum], r4, %[ones], %[sum]\n\t"                                                 \
    "smlad %[sum], r5, %[ones], %[sum]\n\t"                                                 \
    "smlad %[sum], r6, %[ones], %[sum]\n\t"                                                 \
    "smlad %[sum], r8, %[ones], %[sum]\n\t"                                                 \
    "usub16 %[x], r4, r5\n\tsel %[x], r5, r4\n\tsel r4, r4, r5\n\t" /* x lesser, r4 greater */ \
    "usub16 r5, r6, r8\n\tsel r5, r8, r6\n\tsel r6, r6, r8\n\t"     /* r5 lesser, r6 greater */ \
    "usub16 r8, %[low], %[x]\n\tsel %[low], %[x], %[low]\n\t"                               \
    "usub16 r8, %[low], r5\n\tsel %[low], r5, %[low]\n\t"                                   \
    "usub16 r8, %[high], r4\n\tsel %[high], %[high], r4\n\t"                                \
    "usub16 r8, %[high], r6\n\tsel %[high], %[high], r6\n\t"

#define PAIRS_OF_THIRTYTWO PAIRS_OF_EIGHT PAIRS_OF_EIGHT PAIRS_OF_EIGHT PAIRS_OF_EIGHT

/* USUB16 a, b sets the flags where a >= b; SEL takes its first operand there. */
static inline const uint16_t *
pair_sixtyfours(struct reduction *s, const uint16_t *at, const uint16_t *end)
{
    uint32_t x;
    __asm__ volatile("1:\n\t" PAIRS_OF_THIRTYTWO PAIRS_OF_THIRTYTWO "cmp %[at], %[end]\n\tbne 1b"
                     : [at] "+r"(at), [sum] "+r"(s->sum), [low] "+r"(s->low), [high] "+r"(s->high), [x] "=&r"(x)
                     : [end] "r"(end), [ones] "r"(0x00010001u)
                     : "r4", "r5", "r6", "r8", "cc", "memory");
    return at;
}

static inline const uint16_t *
pair_eights(struct reduction *s, const uint16_t *at, const uint16_t *end)
{
    uint32_t x;
    __asm__ volatile("1:\n\t" PAIRS_OF_EIGHT "cmp %[at], %[end]\n\tbne 1b"
                     : [at] "+r"(at), [sum] "+r"(s->sum), [low] "+r"(s->low), [high] "+r"(s->high), [x] "=&r"(x)
                     : [end] "r"(end), [ones] "r"(0x00010001u)
                     : "r4", "r5", "r6", "r8", "cc", "memory");
    return at;
}

/* Two at a time, what is left of less than 8. */
static inline const uint16_t *
pair_twos(struct reduction *s, const uint16_t *at, const uint16_t *end)
{
    uint32_t x, y;
    __asm__ volatile("1: ldr %[x], [%[at]], #4\n\t"
                     "smlad %[sum], %[x], %[ones], %[sum]\n\t"
                     "usub16 %[y], %[low], %[x]\n\tsel %[low], %[x], %[low]\n\t"
                     "usub16 %[y], %[high], %[x]\n\tsel %[high], %[high], %[x]\n\t"
                     "cmp %[at], %[end]\n\tbne 1b"
                     : [at] "+r"(at), [sum] "+r"(s->sum), [low] "+r"(s->low), [high] "+r"(s->high), [x] "=&r"(x), [y] "=&r"(y)
                     : [end] "r"(end), [ones] "r"(0x00010001u)
                     : "cc", "memory");
    return at;
}

static inline void
reduction_begin(struct reduction *r)
{
    *r = (struct reduction){0, 0xffffffffu, 0};
}

static inline void
reduction_add(struct reduction *r, const uint16_t *samples, uint32_t count)
{
    struct reduction s = *r;
    const uint16_t *end = samples + count;
    if ((uintptr_t)samples & 2u && count)
        pair_single(&s, *samples++);
    uint32_t left = (uint32_t)(end - samples);
    if (left & ~63u)
        samples = pair_sixtyfours(&s, samples, samples + (left & ~63u));
    if (left & 56u)
        samples = pair_eights(&s, samples, samples + (left & 56u));
    if (left & 6u)
        samples = pair_twos(&s, samples, samples + (left & 6u));
    if (left & 1u)
        pair_single(&s, *samples);
    *r = s;
}

static inline uint16_t
reduction_min(const struct reduction *r)
{
    uint32_t odd = r->low >> 16, even = r->low & 0xffffu;
    return (uint16_t)(odd < even ? odd : even);
}

static inline uint16_t
reduction_max(const struct reduction *r)
{
    uint32_t odd = r->high >> 16, even = r->high & 0xffffu;
    return (uint16_t)(odd > even ? odd : even);
}

#endif
