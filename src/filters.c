/* Theory and formats: filters.h.  Called in irq context, at most once a block (about 120 times a second). */
#include "filters.h"

void
ema_init(struct ema *f, uint8_t shift)
{
    f->state = 0;
    f->shift = shift > EMA_SHIFT_MAX ? EMA_SHIFT_MAX : shift;
    f->primed = 0;
}

void
ema_restart(struct ema *f)
{
    f->primed = 0;
}

uint32_t
ema_update(struct ema *f, uint32_t input)
{
    int32_t scaled = (int32_t)(input << EMA_FRACTION_BITS);
    if (!f->primed || !f->shift) {
        f->state = scaled;
        f->primed = 1;
        return input;
    }
    /* gcc and clang shift negative numbers arithmetically (gcc manual, "Integers implementation"): floor */
    f->state += (scaled - f->state + ((int32_t)1 << (f->shift - 1))) >> f->shift;
    return ((uint32_t)f->state + (1u << (EMA_FRACTION_BITS - 1))) >> EMA_FRACTION_BITS;
}
