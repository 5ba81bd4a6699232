// Kalman filter in temperature and unexplained heating rate. See temperature_filter.h.

#include "temperature_filter.h"
#include "pipeline.h"
#include "thermal/models/physics.h"
#include <math.h>

#define RATE_START 900.0 // (K/s)^2: variance of the unexplained rate at a start; 30 K/s

static double
fourth_power(double x)
{
    return x * x * x * x;
}

double
nozzle_loss_w(double conductance_w_k, double radiation_m2, double ambient_c, double temp_c)
{
    double hot4 = fourth_power(temp_c + ZERO_CELSIUS_K), ambient4 = fourth_power(ambient_c + ZERO_CELSIUS_K);
    return fmax(0.0, conductance_w_k * (temp_c - ambient_c) + STEFAN_BOLTZMANN * radiation_m2 * (hot4 - ambient4));
}

void
filter_reset(struct filter_state *s)
{
    *s = (struct filter_state){.time_s = NAN, .end_s = NAN, .measured_s = NAN, .temp_c = NAN};
}

// Begin anew with this block's own temperature.
static int
restart(struct filter_state *s, struct coil_block *b)
{
    s->temp_c = b->temp_c;
    s->rate_k_s = s->p_tq = s->innovation_c = 0.0;
    s->p_tt = b->noise_c * b->noise_c;
    s->p_qq = RATE_START;
    s->outliers = 0;
    s->time_s = s->measured_s = b->centre_s;
    b->tracked_c = b->temp_c;
    b->tracked_sigma_c = b->sigma_c;
    b->tracked_noise_c = b->noise_c;
    return b->is_tracked = 1;
}

// Move the state to the block's centre; the power before held until the end of the block before.
static void
predict(const struct filter_params *p, struct filter_state *s, const struct coil_block *b)
{
    double dt_s = b->centre_s - s->time_s;
    double before_s = fmin(fmax(0.0, s->end_s - s->time_s), dt_s);
    double mean_w = dt_s > 0.0 ? (s->power_w * before_s + b->heat_w * (dt_s - before_s)) / dt_s : b->heat_w;
    double lost_w = nozzle_loss_w(p->conductance_w_k, p->radiation_m2, p->ambient_c, s->temp_c);
    double rise_k_s = (mean_w - lost_w) / (p->capacity_j_k + p->capacity_slope_j_k2 * s->temp_c);
    s->temp_c += (rise_k_s + s->rate_k_s) * dt_s;
    s->p_tt += dt_s * (2.0 * s->p_tq + dt_s * s->p_qq + p->temp_noise);
    s->p_tq += dt_s * s->p_qq;
    s->p_qq += dt_s * p->rate_noise;
    s->time_s = b->centre_s;
}

static int
update(const struct filter_params *p, struct filter_state *s, struct coil_block *b)
{
    double noise = b->noise_c * b->noise_c, spread = s->p_tt + noise;
    double innovation_c = b->temp_c - s->temp_c;
    s->innovation_c = innovation_c;
    if (fabs(innovation_c) > p->gate_sigma * sqrt(spread) + p->gate_c) {
        s->outliers++;
        return s->outliers < p->outliers_max ? 0 : restart(s, b);
    }
    s->outliers = 0;
    double gain_t = s->p_tt / spread, gain_q = s->p_tq / spread;
    s->temp_c += gain_t * innovation_c;
    s->rate_k_s += gain_q * innovation_c;
    s->p_qq -= gain_q * s->p_tq;
    s->p_tq -= gain_t * s->p_tq;
    s->p_tt -= gain_t * s->p_tt;
    s->measured_s = s->time_s;
    b->tracked_c = s->temp_c;
    b->tracked_sigma_c = sqrt(fmax(0.0, b->sigma_c * b->sigma_c - noise) + s->p_tt);
    b->tracked_noise_c = sqrt(s->p_tt);
    return b->is_tracked = 1;
}

int
filter_block(const struct filter_params *p, struct filter_state *s, struct coil_block *b)
{
    b->is_tracked = 0;
    int usable = b->fault == BLOCK_GOOD;
    int gap = !(b->end_s - s->measured_s <= p->gap_s); // also with nothing measured yet: NaN
    int anew = gap || b->time_s < s->time_s;
    if (anew)
        s->measured_s = NAN;
    else
        predict(p, s, b);
    s->end_s = b->end_s;
    s->power_w = b->heat_w;
    if (!usable)
        return 0;
    return anew ? restart(s, b) : update(p, s, b);
}
