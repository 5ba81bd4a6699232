// What the drive by itself adds to the reading. See drive_offset.h.

#include "drive_offset.h"
#include "pipeline.h"
#include <math.h>

#define SHAPE 1.3           // between the exponents of detuning (1.2), supply (1.6) and resistance (1.4)
#define START_C 60.0        // 1 sigma of k before any step: what 4 % of supply and 0.1 % of C1 make together
#define WALK_C 0.25         // of k within a second at little drive ...
#define STRONG_C 20.0       // ... and at full drive, by h^2: ripple and sag of the supply
#define STRONG_MAX_S 1.0    // ... since the strong block before; no more after so long
#define WARM_C 0.7          // ... and while the nozzle warms by a degree: the law's error changes with the temperature
#define OTHER_C 3.0         // ... and while the strong drive moves by the whole of h: the shape is not quite right ...
#define OTHER_SHARE 0.5     // ... by this share of k
#define STEP_MIN 0.02       // of h: smaller steps show too little
#define GAP_S 0.006         // longer after the block before, too little is known of what happened between
#define RISE_DOUBT 0.15     // of the temperature's own change between the two blocks
#define SHAPE_DOUBT 0.15    // of the correction, between drives
#define LOOK_MIN 0.25       // a step of h that says much of k
#define RIPPLE_S 0.02       // memory of how readings at one strong drive swing: from 8 Hz on
#define RIPPLE_START_C 10.0 // before any of them
#define RIPPLE_MIN 0.25     // ... from this h on
#define RIPPLE_MIN_C 2.5    // less is noise, and a heating rate that is wrong by a third
#define GATE_SIGMA 5.0      // a reading farther off is a disturbance, or k has jumped: the next step decides

void
drive_offset_reset(struct drive_offset *s)
{
    *s = (struct drive_offset){.variance = START_C * START_C,
                               .ripple_c2 = RIPPLE_START_C * RIPPLE_START_C,
                               .time_s = NAN,
                               .look_s = -INFINITY};
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

// 1 sigma of what a ripple of the supply adds to one reading at full drive.
static double
ripple_c(const struct drive_offset *s)
{
    return sqrt(fmax(0.0, s->ripple_c2 - RIPPLE_MIN_C * RIPPLE_MIN_C));
}

// Two blocks of one strong drive show the ripple.
static void
follow_ripple(struct drive_offset *s, const struct coil_block *b, double h, double rise_c, double dt_s)
{
    double off_c = (b->temp_c - s->reading_c - rise_c) / h, share = dt_s / (RIPPLE_S + dt_s);
    s->swing_c = (s->swing_c + off_c) * (1.0 - share);
    s->ripple_c2 += (s->swing_c * s->swing_c - s->ripple_c2) * share;
}

static void
learn(struct drive_offset *s, const struct coil_block *b, double step, double rise_c)
{
    double off_c = b->temp_c - s->reading_c - rise_c - s->full_c * step;
    double noise = b->noise_c * b->noise_c + s->noise_c * s->noise_c + pow(RISE_DOUBT * rise_c, 2.0);
    noise += pow(ripple_c(s) * step, 2.0);
    double spread = step * step * s->variance + noise;
    if (off_c * off_c > GATE_SIGMA * GATE_SIGMA * spread) {
        s->variance = fmin(START_C * START_C, s->variance + pow(off_c / step, 2.0));
        return;
    }
    double gain = s->variance * step / spread;
    s->full_c += gain * off_c;
    s->variance -= gain * step * s->variance;
    if (fabs(step) > LOOK_MIN) {
        s->look = fmax(s->lever, s->lever + step);
        s->look_s = b->centre_s;
    }
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
        double since_s = h > STEP_MIN ? fmax(dt_s, fmin(STRONG_MAX_S, b->centre_s - s->strong_s)) : dt_s;
        double walk = walk_c * walk_c * since_s + WARM_C * WARM_C * fabs(rise_c) + shape_c * shape_c * other;
        s->variance = fmin(START_C * START_C, s->variance + walk);
        if (dt_s < GAP_S && fabs(h - s->lever) > STEP_MIN)
            learn(s, b, h - s->lever, rise_c);
        else if (dt_s < GAP_S && h > RIPPLE_MIN)
            follow_ripple(s, b, h, rise_c, dt_s);
    }
    s->variance = fmax(s->variance, pow(ripple_c(s), 2.0)); // looks may keep step with the ripple
    double doubt_c = h * hypot(hypot(sqrt(s->variance), ripple_c(s)), SHAPE_DOUBT * s->full_c * (1.0 - h));
    s->noise_c = b->noise_c;
    b->temp_c -= s->full_c * h;
    b->sigma_c = hypot(b->sigma_c, doubt_c);
    b->noise_c = hypot(b->noise_c, doubt_c);
    s->time_s = b->centre_s;
    s->reading_c = reading_c;
    s->temp_c = b->temp_c;
    s->lever = h;
    if (h > STEP_MIN) {
        s->strong = h;
        s->strong_s = b->centre_s;
    }
    s->heat_w = b->heat_w;
    s->half_s = 0.5 * b->duration_s;
}
