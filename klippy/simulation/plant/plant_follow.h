// A recorded drive through the plant: what its blocks would have read without noise (klippy/simulation/identify).
#ifndef FERRITE_SIM_PLANT_FOLLOW_H
#define FERRITE_SIM_PLANT_FOLLOW_H

// Doubles only: Python fills an array of them as a table.
struct follow_step {
    double lasts_s, phase_ticks, flow_mm3_s, fan;
};

// A plant of `values` (plant_param_count of them, in table order) goes through the steps. raw: of each
// step the mean of the codes, settled, before quantisation and limits.
void plant_follow(const double *values, const struct follow_step *steps, int count, double *raw);

#endif
