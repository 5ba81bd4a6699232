// What the drive by itself adds to the reading. See drive_offset.h.

#include "drive_offset.h"
#include "pipeline.h"
#include <math.h>

#define SHAPE 1.3           // between the exponents of detuning (1.2), supply (1.6) and resistance (1.4)
#define START_C 60.0        // 1 sigma of k before any step: what 4 % of supply and 0.1 % of C1 make together
#define WALK_C 0.25         // of k within a second at little drive ...
#define STRONG_C 20.0       // ... and at full drive, by h^2: ripple and sag of the supply
#define WARM_C 0.7          // ... and while the nozzle warms by a degree: the law's error changes with the temperature
#define OTHER_C 3.0         // ... and while the strong drive moves by the whole of h: the shape is not quite right ...
#define OTHER_SHARE 0.5     // ... by this share of k
#define STEP_MIN 0.02       // of h: smaller steps show too little
#define GAP_S 0.006         // longer after the block before, too little is known of what happened between
#define RISE_DOUBT 0.15     // of the temperature's own change between the two blocks
#define SHAPE_DOUBT 0.15    // of the correction, between drives
#define GATE_SIGMA 5.0      // a reading farther off is a disturbance, or k has jumped: the next step decides
#define JUMP_SHARE 0.1      // of a block in the mean square of k's jumps between blocks at one drive

void
drive_offset_reset(struct drive_offset *s)
{
    *s = (struct drive_offset){.variance = START_C * START_C, .time_s = NAN};
}

// The temperature's own change between the two blocks' centres.
static double
rise_between(const struct drive_offset *s, const struct filter_params *p, double rate_k_s, const struct coil_block *b)
{
    double dt_s = b->centre_s - s->time_s, before_s = fmin(s->half_s, dt_s);
    double lost_w = nozzle_loss_w(p->conductance_w_k, p->radiation_m2, p->ambient_c, s->temp_c);
    double heat_j = s->heat_w * before_s + b->heat_w * (dt_s - before_s) - lost_w * dt_s;
    return heat_j / (p->capacity_j_k + p->capacity_slope_j_k2 * s->temp_c) + rate_k_s * dt_s;
}

static double
noise_between(const struct drive_offset *s, const struct coil_block *b, double rise_c)
{
    return b->noise_c * b->noise_c + s->noise_c * s->noise_c + pow(RISE_DOUBT * rise_c, 2.0);
}

static void
learn(struct drive_offset *s, const struct coil_block *b, double step, double rise_c)
{
    double off_c = b->temp_c - s->reading_c - rise_c - s->full_c * step;
    double spread = step * step * s->variance + noise_between(s, b, rise_c);
    if (off_c * off_c > GATE_SIGMA * GATE_SIGMA * spread) {
        s->variance = fmin(START_C * START_C, s->variance + pow(off_c / step, 2.0));
        return;
    }
    double gain = s->variance * step / spread;
    s->full_c += gain * off_c;
    s->variance -= gain * step * s->variance;
}

// Between two blocks at one strong drive k should hardly move. Where it jumps it follows the supply's ripple, and looks may
// keep step with that.
static void
note_swing(struct drive_offset *s, const struct coil_block *b, double h, double rise_c, double walk)
{
    double off_c = b->temp_c - s->reading_c - rise_c, moved = fmin(START_C * START_C, pow(off_c / h, 2.0));
    if (off_c * off_c > GATE_SIGMA * GATE_SIGMA * (noise_between(s, b, rise_c) + h * h * walk))
        s->swing = fmax(s->swing, moved);
    else if (s->swing)
        s->swing += JUMP_SHARE * (moved - s->swing);
}

void
drive_offset_block(struct drive_offset *s, const struct filter_params *p, double rate_k_s, double phase_max,
                   struct coil_block *b)
{
    if (b->fault != BLOCK_GOOD)
        return;
    double share = b->phase_ticks / phase_max, h = pow(share * share, SHAPE), reading_c = b->temp_c;
    if (b->centre_s > s->time_s) {
        double dt_s = b->centre_s - s->time_s, rise_c = rise_between(s, p, rate_k_s, b);
        double other = h > STEP_MIN ? fabs(h - s->strong) : 0.0;
        double walk_c = WALK_C + STRONG_C * h * h;
        double shape_c = hypot(OTHER_C, OTHER_SHARE * s->full_c);
        double walk = walk_c * walk_c * dt_s + WARM_C * WARM_C * fabs(rise_c) + shape_c * shape_c * other;
        s->variance = fmin(START_C * START_C, s->variance + walk);
        if (dt_s < GAP_S && fabs(h - s->lever) > STEP_MIN)
            learn(s, b, h - s->lever, rise_c);
        else if (dt_s < GAP_S && h > STEP_MIN)
            note_swing(s, b, h, rise_c, walk);
    }
    s->variance = fmax(s->variance, s->swing);
    double doubt_c = h * hypot(sqrt(s->variance), SHAPE_DOUBT * s->full_c * (1.0 - h));
    s->noise_c = b->noise_c;
    b->temp_c -= s->full_c * h;
    b->sigma_c = hypot(b->sigma_c, doubt_c);
    b->noise_c = hypot(b->noise_c, doubt_c);
    s->time_s = b->centre_s;
    s->reading_c = reading_c;
    s->temp_c = b->temp_c;
    s->lever = h;
    s->strong = h > STEP_MIN ? h : s->strong;
    s->heat_w = b->heat_w;
    s->half_s = 0.5 * b->duration_s;
}
