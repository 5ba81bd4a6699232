// What the drive by itself adds to the reading. See drive_offset.h.

#include "drive_offset.h"
#include "pipeline.h"
#include <math.h>

#define DRIVE_SHAPE 1.3     // detuning, supply, resistance: exponents 1.2 to 1.6
#define START_C 60.0        // 1 sigma at full drive before any step: 4 % of supply and 0.1 % of C1
#define WALK_C 0.25         // of k within a second ...
#define WARM_C 0.7          // ... and while the nozzle warms by a degree: the law's error changes with the temperature
#define STEP_MIN 0.02       // of h: smaller steps say too little
#define GAP_S 0.006         // a step within this time shows
#define RISE_DOUBT 0.15     // of the temperature's own change between the two blocks
#define SHAPE_DOUBT 0.15    // of the correction, between drives

void
drive_offset_reset(struct drive_offset *s)
{
    *s = (struct drive_offset){.variance = START_C * START_C, .time_s = NAN};
}

void
drive_offset_block(struct drive_offset *s, const struct filter_params *p, double rate_k_s, double phase_max,
                   struct coil_block *b)
{
    double share = b->phase_ticks / phase_max, h = pow(share * share, DRIVE_SHAPE);
    double dt_s = b->centre_s - s->time_s;
    if (b->fault != BLOCK_GOOD)
        return;
    if (dt_s > 0.0) {
        s->variance = fmin(START_C * START_C, s->variance + WALK_C * WALK_C * dt_s + WARM_C * WARM_C * fabs(b->temp_c - s->temp_c - s->full_c * (h - s->lever)));
        double step = h - s->lever;
        if (dt_s < GAP_S && fabs(step) > STEP_MIN) {
            double before_s = fmin(s->half_s, dt_s), lost_w = nozzle_loss_w(p->conductance_w_k, p->radiation_m2,
                                                                           p->ambient_c, b->temp_c);
            double heat_j = s->heat_w * before_s + b->heat_w * (dt_s - before_s) - lost_w * dt_s;
            double rise_c = heat_j / (p->capacity_j_k + p->capacity_slope_j_k2 * b->temp_c) + rate_k_s * dt_s;
            double noise_c2 = b->noise_c * b->noise_c + s->noise_c * s->noise_c + pow(RISE_DOUBT * rise_c, 2.0);
            double spread = step * step * s->variance + noise_c2;
            double gain = s->variance * step / spread;
            s->full_c += gain * (b->temp_c - s->temp_c - rise_c - s->full_c * step);
            s->variance -= gain * step * s->variance;
        }
    }
    s->time_s = b->centre_s;
    s->temp_c = b->temp_c;
    s->noise_c = b->noise_c;
    s->lever = h;
    s->heat_w = b->heat_w;
    s->half_s = 0.5 * b->duration_s;
    b->temp_c -= s->full_c * h;
    b->sigma_c = hypot(b->sigma_c, h * hypot(sqrt(s->variance), SHAPE_DOUBT * s->full_c * (1.0 - h)));
}
