// plant_advance along a list of steps, with the settled signal in place of samples.
#include "plant_follow.h"

#include "plant.h"

static double settled_raw(struct plant *p)
{
    return p->v.adc_zero + tank_steady_error(&p->tank, &p->v, p->skin_c) / p->v.units_per_lsb;
}

void plant_follow(const double *values, const struct follow_step *steps, int count, double *raw)
{
    struct plant p;
    plant_init(&p, values, 1);
    for (int i = 0; i < count; i++) {
        plant_set_inputs(&p, steps[i].flow_mm3_s, steps[i].fan);
        plant_set_phase(&p, steps[i].phase_ticks);
        const double start_raw = settled_raw(&p);
        plant_advance(&p, steps[i].lasts_s);
        raw[i] = 0.5 * (start_raw + settled_raw(&p));
    }
}
