/* Theory, formats and contexts: signal_test.h. */
#include "signal_test.h"

#include "oversample_kernel.h"

enum { COMPARABLE_SHIFT = 5, RIPPLE_SHIFT = 15, HARD_SHIFT = 12, RATE_SHIFT = 6 };
#define HARD_PHASE 0x8000u
static const uint32_t RATE_SPAN_MAX = 1u << 15;

static uint8_t
is_learning(const struct signal_test *t)
{
    return t->limits.moved_high && t->learned_moves < SIGNAL_TEST_LEARN;
}

static uint8_t
is_before(uint32_t a, uint32_t b)
{
    return (int32_t)(a - b) < 0;
}

void
signal_test_init(struct signal_test *t)
{
    *t = (struct signal_test){.before_kind = SIGNAL_TEST_OFF};
}

uint8_t
signal_test_configure(struct signal_test *t, struct signal_test_limits limits)
{
    if (limits.moved_low > limits.moved_high || limits.off_low > limits.off_high)
        return 0;
    if (limits.interval < 4 * SIGNAL_TEST_OFF_LEN && (limits.moved_high || limits.off_high))
        return 0;
    t->limits = limits;
    return 1;
}

uint8_t
signal_test_is_due(const struct signal_test *t, uint32_t index)
{
    return (t->limits.moved_high || t->limits.off_high) && !t->kind && !is_before(index, t->due);
}

enum signal_test_kind
signal_test_plan(struct signal_test *t, uint32_t at, uint16_t phase)
{
    uint8_t can_move = t->limits.moved_high != 0, can_off = t->limits.off_high && phase < SIGNAL_TEST_OFF_PHASE;
    uint8_t move = t->bad_moves || is_learning(t) || t->before_kind != SIGNAL_TEST_MOVE;
    if (!can_move || !can_off)
        move = can_move;
    if (!can_move && !can_off)
        return SIGNAL_TEST_NONE;
    t->kind = move ? SIGNAL_TEST_MOVE : SIGNAL_TEST_OFF;
    t->begun = t->ended = 0;
    t->planned = at;
    t->before = t->inside = t->after = 0;
    return (enum signal_test_kind)t->kind;
}

uint16_t
signal_test_length(const struct signal_test *t)
{
    return t->kind == SIGNAL_TEST_MOVE ? SIGNAL_TEST_EDGE + SIGNAL_TEST_LEN : SIGNAL_TEST_OFF_LEN;
}

void
signal_test_begin(struct signal_test *t, uint32_t index)
{
    t->from = index;
    t->begun = 1;
}

void
signal_test_end(struct signal_test *t, uint32_t index, uint16_t settle)
{
    t->to = index + (t->kind == SIGNAL_TEST_MOVE ? SIGNAL_TEST_EDGE : settle);
    t->ended = 1;
}

enum signal_test_kind
signal_test_cancel(struct signal_test *t, uint32_t index, uint16_t settle)
{
    uint8_t undo = t->begun && !t->ended ? t->kind : SIGNAL_TEST_NONE;
    if (undo) {
        signal_test_end(t, index, settle);
        t->due = t->to;
    }
    t->kind = SIGNAL_TEST_NONE;
    return (enum signal_test_kind)undo;
}

uint8_t
signal_test_run(struct signal_test *t, uint32_t index, uint16_t count, uint16_t *run)
{
    *run = count;
    if (!t->begun)
        return 0;
    uint8_t skip = !is_before(index, t->from);
    if (skip && t->ended && !is_before(index, t->to)) {
        t->begun = t->kind != SIGNAL_TEST_NONE;
        return 0;
    }
    if (skip && !t->ended)
        return 1;
    uint32_t left = (skip ? t->to : t->from) - index;
    if (left < count)
        *run = (uint16_t)left;
    return skip;
}

/* The sum of those samples that lie within SIGNAL_TEST_LEN from `start` on. */
static uint32_t
sum_within(const uint16_t *samples, uint32_t index, uint16_t count, uint32_t start)
{
    int32_t first = (int32_t)(start - index), end = first + SIGNAL_TEST_LEN;
    if (first < 0)
        first = 0;
    if (end > count)
        end = count;
    if (end <= first)
        return 0;
    struct reduction r;
    reduction_begin(&r);
    reduction_add(&r, samples + first, (uint16_t)(end - first));
    return r.sum;
}

/* The test is over: count it, plan the next. */
static enum guard_trip
conclude(struct signal_test *t, uint8_t good, uint8_t *bad, enum guard_trip trip, uint32_t index)
{
    *bad = good ? 0 : (uint8_t)(*bad + 1);
    t->before_kind = t->kind;
    t->kind = SIGNAL_TEST_NONE;
    t->due = t->bad_moves || t->bad_offs || is_learning(t) ? index : index + t->limits.interval;
    return *bad >= SIGNAL_TEST_BAD ? trip : GUARD_TRIP_NONE;
}

/* Within the limits, and as far as those before; learned while there are too few. */
static uint8_t
is_move_good(struct signal_test *t, int32_t moved)
{
    const struct signal_test_limits *l = &t->limits;
    if (moved < 2 * (int32_t)l->moved_low || moved > 2 * (int32_t)l->moved_high)
        return 0;
    if (is_learning(t)) {
        t->learned += (uint32_t)moved;
        t->learned_moves++;
        return 1;
    }
    int32_t off = (int32_t)SIGNAL_TEST_LEARN * moved - (int32_t)t->learned;
    uint32_t allowed = (t->learned * l->tolerance >> 8) + 2u * SIGNAL_TEST_LEARN * l->slack;
    return (uint32_t)(off < 0 ? -off : off) <= allowed;
}

static enum guard_trip
feed_move(struct signal_test *t, const uint16_t *samples, uint32_t index, uint16_t count)
{
    t->before += sum_within(samples, index, count, t->planned - SIGNAL_TEST_LEN);
    if (t->begun)
        t->inside += sum_within(samples, index, count, t->from + SIGNAL_TEST_EDGE);
    if (!t->ended)
        return GUARD_TRIP_NONE;
    t->after += sum_within(samples, index, count, t->to);
    if (is_before(index + count, t->to + SIGNAL_TEST_LEN))
        return GUARD_TRIP_NONE;
    int32_t moved = (int32_t)(2 * t->inside - t->before - t->after); /* 1/32 LSB */
    return conclude(t, is_move_good(t, moved), &t->bad_moves, GUARD_TRIP_UNMOVED, index + count);
}

static uint8_t
shows_no_current(const struct signal_test *t, uint32_t sum, uint16_t count)
{
    return sum >= (uint32_t)t->limits.off_low * count && sum <= (uint32_t)t->limits.off_high * count;
}

static enum guard_trip
feed_off(struct signal_test *t, const uint16_t *samples, uint32_t index, uint16_t count)
{
    if (!t->begun)
        return GUARD_TRIP_NONE;
    t->inside += sum_within(samples, index, count, t->from + SIGNAL_TEST_OFF_LEN - SIGNAL_TEST_LEN);
    if (!t->ended || is_before(index + count, t->to))
        return GUARD_TRIP_NONE;
    return conclude(t, shows_no_current(t, t->inside, SIGNAL_TEST_LEN), &t->bad_offs, GUARD_TRIP_CONDUCTS, index + count);
}

enum guard_trip
signal_test_feed(struct signal_test *t, const uint16_t *samples, uint32_t index, uint16_t count)
{
    if (!t->kind)
        return GUARD_TRIP_NONE;
    if (t->kind == SIGNAL_TEST_MOVE)
        return feed_move(t, samples, index, count);
    return feed_off(t, samples, index, count);
}

static uint8_t
comparable(const struct signal_test *t, const struct guard_input *block, uint32_t span)
{
    uint16_t phase = block->phase;
    uint16_t difference = phase < t->jump_phase ? (uint16_t)(t->jump_phase - phase) : (uint16_t)(phase - t->jump_phase);
    return t->jump_count && difference <= phase >> COMPARABLE_SHIFT && span < RATE_SPAN_MAX;
}

static uint32_t
jump_limit(const struct signal_test *t, uint16_t phase)
{
    uint32_t jump = t->limits.jump, hard = phase > HARD_PHASE ? (uint32_t)phase - HARD_PHASE : 0;
    return jump + (jump * phase >> RIPPLE_SHIFT) + (jump * hard >> HARD_SHIFT);
}

static uint8_t
jumps(const struct signal_test *t, const struct guard_input *block, uint32_t span)
{
    uint32_t moved = block->sum < t->jump_sum ? t->jump_sum - block->sum : block->sum - t->jump_sum;
    if (block->count == t->jump_count && moved <= (uint32_t)t->limits.jump * block->count >> 4)
        return 0; /* as nearly always: within the limit of a weak drive */
    if (!t->limits.jump || block->phase < t->limits.phase || !comparable(t, block, span))
        return 0;
    uint64_t sum = (uint64_t)block->sum * t->jump_count, before = (uint64_t)t->jump_sum * block->count;
    uint8_t fell = sum < before;
    uint32_t limit = jump_limit(t, block->phase);
    limit += (fell ? t->limits.fall : t->limits.rise) * span >> RATE_SHIFT;
    uint64_t allowed = (uint64_t)limit * ((uint32_t)block->count * t->jump_count) >> 4;
    return (fell ? before - sum : sum - before) > allowed;
}

enum guard_trip
signal_test_block(struct signal_test *t, const struct guard_input *block, uint32_t first)
{
    uint8_t conducts = t->limits.off_high && !block->phase && !shows_no_current(t, block->sum, block->count);
    t->bad_idles = conducts ? (uint8_t)(t->bad_idles + 1) : 0;
    if (t->bad_idles >= SIGNAL_IDLE_BLOCKS)
        return GUARD_TRIP_CONDUCTS;
    uint32_t end = first + block->count;
    if (jumps(t, block, end - t->jump_end))
        return ++t->bad_jumps >= SIGNAL_JUMP_BLOCKS ? GUARD_TRIP_JUMP : GUARD_TRIP_NONE;
    t->bad_jumps = 0;
    t->jump_sum = block->sum;
    t->jump_count = block->count;
    t->jump_phase = block->phase;
    t->jump_end = end;
    return GUARD_TRIP_NONE;
}

uint16_t
signal_test_moved(const struct signal_test *t)
{
    return is_learning(t) ? 0 : (uint16_t)(t->learned >> SIGNAL_TEST_LEARN_SHIFT >> 1);
}
