/* Theory, formats and contexts: oversample.h. */
#include "oversample.h"

static uint16_t
saturating_add(uint16_t a, uint32_t b)
{
    return b > (uint32_t)(UINT16_MAX - a) ? UINT16_MAX : (uint16_t)(a + b);
}

static void
begin_block(struct oversample *o)
{
    o->count = 0;
    reduction_begin(&o->reduction);
}

uint8_t
oversample_init(struct oversample *o, struct oversample_config config)
{
    if (config.y < OVERSAMPLE_Y_MIN || config.y > OVERSAMPLE_Y_MAX || config.ema_shift > EMA_SHIFT_MAX)
        return 0;
    uint16_t longest = (uint16_t)(1u << (2 * config.y)), length = config.block_len ? config.block_len : longest;
    if (length > longest || length < longest >> 4)
        return 0;
    *o = (struct oversample){.config = config};
    o->block_len = length;
    o->cut_len = (uint16_t)((length + (1u << OVERSAMPLE_CUT_SHIFT) - 1) >> OVERSAMPLE_CUT_SHIFT);
    ema_init(&o->ema, config.ema_shift);
    begin_block(o);
    return 1;
}

static void
finish_block(struct oversample *o, struct oversample_block *block)
{
    uint32_t value = o->reduction.sum >> o->config.y;
    if (o->config.ema_shift && o->count == o->block_len)
        value = ema_update(&o->ema, value);
    *block = (struct oversample_block){
        .first = o->first,
        .value = value,
        .sum = o->reduction.sum,
        .count = o->count,
        .phase = o->phase,
        .min = reduction_min(&o->reduction),
        .max = reduction_max(&o->reduction),
        .discarded = o->discarded,
        .lost = o->lost,
    };
    o->discarded = o->lost = 0;
    begin_block(o);
}

/* End the present block short of its length. */
static uint8_t
cut_block(struct oversample *o, struct oversample_block *block)
{
    uint8_t worth = o->count >= o->cut_len;
    if (worth) {
        finish_block(o, block);
    } else {
        o->discarded = saturating_add(o->discarded, o->count);
        begin_block(o);
    }
    ema_restart(&o->ema);
    return worth;
}

uint8_t
oversample_step(struct oversample *o, uint16_t phase, struct oversample_block *block)
{
    if (phase == o->phase)
        return 0;
    uint8_t finished = cut_block(o, block);
    o->phase = phase;
    o->settle_left = o->config.settle_samples;
    return finished;
}

uint8_t
oversample_gap(struct oversample *o, uint32_t count, struct oversample_block *block)
{
    if (!count)
        return 0;
    uint8_t finished = cut_block(o, block);
    o->lost = saturating_add(o->lost, count);
    o->settle_left = count < o->settle_left ? (uint16_t)(o->settle_left - count) : 0;
    return finished;
}

uint8_t
oversample_skip(struct oversample *o, uint16_t count, struct oversample_block *block)
{
    uint8_t finished = o->count ? cut_block(o, block) : 0;
    o->discarded = saturating_add(o->discarded, count);
    o->settle_left = count < o->settle_left ? (uint16_t)(o->settle_left - count) : 0;
    return finished;
}

uint8_t
oversample_feed(struct oversample *o, const uint16_t *samples, uint16_t count, uint32_t first, uint16_t *taken,
                struct oversample_block *block)
{
    uint32_t settling = 0, room = (uint32_t)(o->block_len - o->count);
    if (o->settle_left) {
        settling = count < o->settle_left ? count : o->settle_left;
        o->settle_left -= (uint16_t)settling;
        o->discarded = saturating_add(o->discarded, settling);
    }
    uint32_t use = count - settling;
    if (use > room)
        use = room;
    *taken = (uint16_t)(settling + use);
    if (!use)
        return 0;
    if (!o->count)
        o->first = first + settling;
    reduction_add(&o->reduction, samples + settling, (uint16_t)use);
    o->count = (uint16_t)(o->count + use);
    if (use < room)
        return 0;
    finish_block(o, block);
    return 1;
}

void
oversample_drop(struct oversample *o, const struct oversample_block *block)
{
    o->discarded = saturating_add(o->discarded, block->discarded);
    o->lost = saturating_add(o->lost, (uint32_t)block->count + block->lost);
}
