/* Vibration of the extruder's mount; see mount.h. */
#include "mount.h"

#include <math.h>

static const double PI = 3.141592653589793;
static const double MM_PER_M = 1e3;
static const double FORCE_N_MIN = 1e-3;
static const double FLOW_MM3_S = 5.0; /* v0 */

void mount_init(struct mount *m, double place_mm, uint64_t seed)
{
    m->x = place_mm;
    m->rate = m->force = 0.0;
    m->left = 0;
    noise_seed(&m->noise, seed);
}

/* White noise of rms s each dt makes a mass of natural frequency f ring with rms s sqrt(pi dt f Q). */
void mount_follow(struct mount *m, const struct plant *p)
{
    double force_n = plant_back_force(p), flow = p->flow_in * p->v.flow_share;
    m->force = 0.0;
    if (force_n < FORCE_N_MIN || flow <= 0.0 || p->v.melt_force_n <= 0.0)
        return;
    double over = m->exponent / p->v.force_hole_exponent;
    double amplitude = m->amplitude_m_s2 * pow(force_n / p->v.melt_force_n, over) *
                       pow(flow / FLOW_MM3_S, m->flow_exponent - over * p->v.force_flow_exponent);
    m->force = amplitude / sqrt(2.0 * PI * m->frequency_hz * m->quality);
}

static double draw(struct mount *m)
{
    if (!m->left) {
        m->rows = noise_run(&m->noise);
        m->left = NOISE_RUN;
    }
    int i = NOISE_RUN - m->left--;
    return m->rows.sign[i] * (m->rows.a[i] + m->rows.b[i]);
}

void mount_set_step(struct mount *m, double step_s)
{
    double w = frame_stepped_w(m->frequency_hz, step_s);
    m->step_s = step_s;
    m->spring = step_s * w * w;
    m->drag = step_s * w / m->quality;
    m->push = MM_PER_M * sqrt(step_s);
}

void mount_step(struct mount *m, double base_mm, double base_rate)
{
    double noise = m->force > 0.0 ? m->push * m->force * draw(m) : 0.0;
    m->rate += m->spring * (base_mm - m->x) + m->drag * (base_rate - m->rate) + noise;
    m->x += m->step_s * m->rate;
}
