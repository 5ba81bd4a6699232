/* Theory, formats and contexts: guard.h. */
#include "guard.h"

void
guard_init(struct guard *g, uint16_t adc_max, uint32_t max_duration, uint32_t silence)
{
    *g = (struct guard){.adc_max = adc_max,
                        .max_duration = max_duration,
                        .silence = silence,
                        .ceiling_share = UINT16_MAX,
                        .flat_code = UINT16_MAX};
}

uint8_t
guard_add_row(struct guard *g, struct guard_row row)
{
    if (g->row_count == GUARD_ROWS_MAX || row.low > row.high)
        return 0;
    if (g->row_count && g->rows[g->row_count - 1].phase >= row.phase)
        return 0;
    g->rows[g->row_count++] = row;
    return 1;
}

void
guard_set_ceiling(struct guard *g, uint16_t phase, uint16_t share)
{
    g->ceiling_phase = phase;
    g->ceiling_share = share;
}

static uint16_t
high_limit(const struct guard *g, const struct guard_row *row, uint16_t phase)
{
    if (phase < g->ceiling_phase || g->ceiling_share == UINT16_MAX)
        return row->high;
    return (uint16_t)(row->low + ((uint32_t)(row->high - row->low) * g->ceiling_share >> 16));
}

/* Has the phase moved while all samples stayed on one code? */
static uint8_t
stands_still(struct guard *g, const struct guard_input *b)
{
    if (b->min != b->max || b->min != g->flat_code) {
        g->flat_code = b->min == b->max ? b->min : UINT16_MAX;
        g->flat_phase = b->phase;
        g->is_stuck = 0;
        return 0;
    }
    int32_t moved = (int32_t)b->phase - g->flat_phase;
    if (moved >= GUARD_STUCK_STEP || moved <= -GUARD_STUCK_STEP)
        g->is_stuck = 1;
    return g->is_stuck;
}

static enum guard_trip
judge(struct guard *g, const struct guard_row *row, const struct guard_input *b)
{
    uint8_t is_stuck = stands_still(g, b);
    if (b->sum < (uint32_t)row->low * b->count)
        return GUARD_TRIP_LOW;
    if (b->sum > (uint32_t)high_limit(g, row, b->phase) * b->count)
        return GUARD_TRIP_HIGH;
    if (b->min == 0 || b->max >= g->adc_max)
        return GUARD_TRIP_CLIPPED;
    if (is_stuck)
        return GUARD_TRIP_STUCK;
    return GUARD_TRIP_NONE;
}

static const struct guard_row *
row_for(const struct guard *g, uint16_t phase)
{
    const struct guard_row *row = 0;
    for (uint8_t i = 0; i < g->row_count && g->rows[i].phase <= phase; i++)
        row = &g->rows[i];
    return row && row->trip_blocks ? row : 0;
}

enum guard_trip
guard_latch(struct guard *g, enum guard_trip trip, uint32_t value, uint16_t count)
{
    if (g->trip)
        return GUARD_TRIP_NONE;
    g->trip = (uint8_t)trip;
    g->trip_value = value;
    g->trip_count = count;
    return trip;
}

enum guard_trip
guard_block(struct guard *g, const struct guard_input *block)
{
    const struct guard_row *row = row_for(g, block->phase);
    enum guard_trip bad = row ? judge(g, row, block) : GUARD_TRIP_NONE;
    if (bad == GUARD_TRIP_NONE) {
        g->bad_blocks = 0;
        return GUARD_TRIP_NONE;
    }
    g->bad_blocks++; /* cannot run over before the trip: 255 in a row trip under every row */
    if (g->bad_blocks < row->trip_blocks)
        return GUARD_TRIP_NONE;
    return guard_latch(g, bad, block->sum, block->count);
}

void
guard_fed(struct guard *g, uint32_t clock, uint16_t phase)
{
    g->fed_clock = clock;
    g->powered = phase > 0;
    g->lapsed = 0;
}

void
guard_off(struct guard *g)
{
    g->powered = g->lapsed = 0;
}

uint8_t
guard_is_waiting(const struct guard *g)
{
    return g->powered || g->lapsed;
}

uint32_t
guard_deadline(const struct guard *g)
{
    return g->fed_clock + (g->powered ? g->max_duration : g->silence);
}

static uint8_t
is_overdue(const struct guard *g, uint32_t clock)
{
    return (int32_t)(clock - guard_deadline(g)) >= 0;
}

uint8_t
guard_lapse(struct guard *g, uint32_t clock)
{
    if (!g->powered || !is_overdue(g, clock))
        return 0;
    g->powered = 0;
    g->lapsed = 1;
    return 1;
}

enum guard_trip
guard_check_silence(struct guard *g, uint32_t clock)
{
    if (!g->lapsed || !is_overdue(g, clock))
        return GUARD_TRIP_NONE;
    return guard_latch(g, GUARD_TRIP_TIMEOUT, clock, 0);
}
