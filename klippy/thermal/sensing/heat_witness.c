// See heat_witness.h.

#include "heat_witness.h"
#include "pipeline.h"
#include <math.h>

#define MEMORY_S 3.0        // a slow drift is the heat-balance monitor's
#define GAP_S 5.0           // longer without a reading: begin anew
#define LOST_S 0.010        // longer between two blocks: some were lost
#define SIGMA_MAX_C 3.0     // a reading in more doubt does not count
#define SHARE_MAX 0.05      // of (phase/max)^2: 1 % of supply is below 0.2 degC there
// Before the first heat-up: 30 % each way of heat and mass, and a coil that couples 3.5 times as well as the published one;
// then what it showed, and 25 % for the supply.
#define RATIO_LOW 0.5
#define RATIO_HIGH 6.0
#define KNOWN_LOW 0.75
#define KNOWN_HIGH 1.3
#define RUN_W 25.0          // a heat-up: so much heat, and ...
#define RUN_K 40.0          // ... so many degrees
#define SIGMAS 4.0
#define WALL_K_W 0.072      // skin above the mean of the wall, q w/3k: 20 degC at 282 W
#define WALL_S 0.05         // five times its relaxation
#define PERSIST_S 0.1       // a disturbance of 5 Hz is over by then
#define GROSS 3.0           // so many times more than allowed is no disturbance
#define CREEP_K_S 0.5       // a chamber warms a nozzle that is off
#define ABOVE_BLOCKS 60     // 0.1 s of weak drive, where a disturbance may look so ...
#define STRONG_BLOCKS 10    // ... but a block of strong drive counts for ten

void
witness_reset(struct witness_state *s)
{
    struct witness_inputs in = s->inputs;
    *s = (struct witness_state){.inputs = in, .block_s = NAN, .end_s = NAN, .beyond_s = NAN, .base_c = INFINITY};
}

static int
is_exact(const struct witness_state *s, double phase_max, const struct coil_block *b)
{
    double share = b->phase_ticks / phase_max;
    return s->inputs.is_on && b->fault == BLOCK_GOOD && b->sigma_c <= SIGMA_MAX_C && share * share <= SHARE_MAX;
}

// Min rise since the block used last.
static double
min_rise(const struct witness_state *s, double c_j_k, double over_k, double dt_s)
{
    const struct witness_inputs *in = &s->inputs;
    double ratio = s->ratio > 0.0 ? KNOWN_LOW * s->ratio : RATIO_LOW;
    return (ratio * s->heat_j - (in->loss_high_w_k * over_k + in->taken_w) * dt_s) / c_j_k;
}

static double
capacity(const struct filter_params *p, double temp_c)
{
    return p->capacity_j_k + p->capacity_slope_j_k2 * temp_c;
}

// Above the target, or, while the nozzle cools down to it, above the lowest reading so far. By an exact reading, or where
// the drive allows none, by the heat that went in since the last.
static void
watch_ceiling(struct witness_state *s, const struct filter_params *p, int exact, const struct coil_block *b)
{
    const struct witness_inputs *in = &s->inputs;
    double dt_s = b->end_s - s->end_s, sure_c = b->temp_c - SIGMAS * b->sigma_c;
    s->base_c += CREEP_K_S * b->duration_s;
    if (exact)
        s->base_c = fmin(s->base_c, b->temp_c);
    else if (dt_s > 0.0 && dt_s < GAP_S)
        sure_c = s->temp_c + min_rise(s, capacity(p, s->temp_c), fmax(s->temp_c - p->ambient_c, 0.0), dt_s);
    else
        return;
    s->base_c = fmax(s->base_c, in->target_c);
    s->above = sure_c > s->base_c + in->room_c ? s->above + (exact ? 1 : STRONG_BLOCKS) : 0;
    if (s->above >= ABOVE_BLOCKS && in->room_c > 0.0)
        s->is_tripped = WITNESS_ABOVE;
}

static void
judge(struct witness_state *s, double end_s)
{
    double worst_c = fmax(s->missing_c, s->surplus_c);
    if (worst_c <= s->allowed_c) {
        s->beyond_s = NAN;
        return;
    }
    if (isnan(s->beyond_s))
        s->beyond_s = end_s;
    if (end_s - s->beyond_s >= PERSIST_S || (worst_c > GROSS * s->allowed_c && end_s > s->beyond_s))
        s->is_tripped = s->missing_c > s->surplus_c ? WITNESS_MISSING : WITNESS_SURPLUS;
}

// The ratio, from one heat-up so far: an error of the reading weighs less the longer it lasts.
static void
learn(struct witness_state *s, double dt_s, double c_j_k, double over_k, double rise_c)
{
    if (s->heat_j < RUN_W * dt_s) {
        s->run_heat_k = s->run_rise_k = s->run_known_k = 0.0;
        return;
    }
    s->run_heat_k += s->heat_j / c_j_k;
    s->run_rise_k += rise_c + 0.5 * (s->inputs.loss_low_w_k + s->inputs.loss_high_w_k) * over_k * dt_s / c_j_k;
    if (s->run_rise_k < s->run_known_k + RUN_K)
        return;
    s->run_known_k = s->run_rise_k;
    s->ratio = fmax(RATIO_LOW, fmin(RATIO_HIGH, s->run_rise_k / s->run_heat_k));
}

static void
compare(struct witness_state *s, const struct filter_params *p, double dt_s, const struct coil_block *b)
{
    const struct witness_inputs *in = &s->inputs;
    double c_j_k = capacity(p, b->temp_c), over_k = fmax(b->temp_c - p->ambient_c, 0.0);
    double rise_c = b->temp_c - s->temp_c, keep = exp(-dt_s / MEMORY_S);
    double low_c = min_rise(s, c_j_k, over_k, dt_s);
    double ratio = s->ratio > 0.0 ? KNOWN_HIGH * s->ratio : RATIO_HIGH;
    double high_c = (ratio * s->heat_j - in->loss_low_w_k * over_k * dt_s) / c_j_k;
    // A nozzle that is off may be wiped, changed or cooled.
    s->missing_c = in->target_c > 0.0 ? fmax(0.0, keep * s->missing_c + low_c - rise_c) : 0.0;
    s->surplus_c = fmax(0.0, keep * s->surplus_c + rise_c - high_c);
    s->allowed_c = in->slack_c + SIGMAS * hypot(b->sigma_c, s->sigma_c) + WALL_K_W * s->peak_w;
    learn(s, dt_s, c_j_k, over_k, rise_c);
    judge(s, b->end_s);
}

void
witness_block(struct witness_state *s, const struct filter_params *p, double phase_max, const struct coil_block *b)
{
    double lasts_s = b->duration_s + b->discarded * b->duration_s / b->count;
    if (!(b->end_s - lasts_s - s->block_s < LOST_S)) // what went in meanwhile is not known
        s->end_s = NAN;
    s->block_s = b->end_s;
    s->heat_j += b->heat_w * lasts_s;
    s->peak_w = fmax(b->heat_w, s->peak_w * exp(-lasts_s / WALL_S));
    if (s->is_tripped)
        return;
    int exact = is_exact(s, phase_max, b);
    if (s->inputs.is_on)
        watch_ceiling(s, p, exact, b);
    if (!exact)
        return;
    double dt_s = b->end_s - s->end_s;
    if (dt_s > 0.0 && dt_s < GAP_S)
        compare(s, p, dt_s, b);
    s->end_s = b->end_s;
    s->temp_c = b->temp_c;
    s->sigma_c = b->sigma_c;
    s->heat_j = 0.0;
}
