#ifndef CHELPER_MODELPLANT_H
#define CHELPER_MODELPLANT_H
// The model a `model` controller holds of its heater. Equations, and what the parameters are: klippy/thermal/models/heater_model.py.

#include <stdint.h>

// ModelParameters: its fields by name, checked there.
struct model_params {
    double heat_j_k, loss_w_k, output_w, output_high;
    double heat_slope_per_k, radiation_m2, ambient_c;
    double second_j_k, link_w_k, second_loss_w_k, element_j_k, element_w_k, sensor_s;
    double output_slope_per_k, fan_w_k;
    double melt_ua_w_k, melt_j_mm3_k, melt_in_c, bore_s, flow_s;
    double hold_s, tau_s, band_c, slew_per_s, delay_s;                                 // what is wanted
    double sigma_c, disturbance_w, disturbance_w2_per_k, disturbance_start_w;   // what is uncertain
    double disturbance_max_w, gain_start, gain_walk, slant_c, second_start, temp_walk_c, coloured_c2_s, gap_s;
    double step_s, prediction_s, remaining, air_k4;                                         // derived
    int32_t ahead;
};

// degC, and the flow at the nozzle in mm^3/s.
struct model_nodes {
    double element_c, temp_c, second_c, sensor_c, bore_c, flow;
};

// What heats: output, the drive's gain, and the disturbance.
struct model_drive {
    double output, gain, disturbance_w;
};

// As min and max of Python: the first of two that compare as neither.
static inline double
lesser(double a, double b)
{
    return b < a ? b : a;
}

static inline double
greater(double a, double b)
{
    return b > a ? b : a;
}

static inline double
bounded(double value, double limit)
{
    return lesser(limit, greater(-limit, value));
}

struct model_nodes model_at_rest(const struct model_params *p, double temp_c);
double model_melt_w_k(const struct model_params *p, double flow_mm3_s);
double model_hold_w(const struct model_params *p, double temp_c, double flow_mm3_s, double fan);
double model_capacity_j_k(const struct model_params *p, double temp_c);
double model_heat_per_output_w(const struct model_params *p, double temp_c);
// The nodes `dt_s` later, in place.
void model_advance(const struct model_params *p, struct model_nodes *nodes, const struct model_drive *drive,
                   double flow_mm3_s, double fan, double dt_s);
// (a - b) / share, and nodes += times * more
struct model_nodes model_nodes_per(const struct model_nodes *a, const struct model_nodes *b, double share);
void model_nodes_add(struct model_nodes *nodes, double times, const struct model_nodes *more);

#endif
