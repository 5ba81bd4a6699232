#ifndef CHELPER_TEMPERATURE_FILTER_H
#define CHELPER_TEMPERATURE_FILTER_H
// Temperature Kalman filter, the input of PID, watermark and two-period control; the heat that goes in is known.
// Its equations and parameters: klippy/thermal/sensing/temperature_filter.py.

#include <stdint.h>

struct coil_block;

struct filter_params {
    double conductance_w_k, radiation_m2, ambient_c;    // loss
    double capacity_j_k, capacity_slope_j_k2;           // C(T) = capacity + slope T
    double rate_noise, temp_noise;
    double gap_s, gate_sigma, gate_c;
    int32_t outliers_max;
};

// Filled with NaN and zeros by filter_reset.
struct filter_state {
    double time_s;              // what T and q belong to; NaN before the first measurement
    double end_s;               // end of the newest block: until then its power held
    double power_w;
    double measured_s;          // newest measurement that entered
    double temp_c, rate_k_s;
    double p_tt, p_tq, p_qq;    // covariance
    double innovation_c;        // newest: measured minus predicted
    int32_t outliers;
};

double nozzle_loss_w(double conductance_w_k, double radiation_m2, double ambient_c, double temp_c);
void filter_reset(struct filter_state *s);
// One block in order of time, estimated; its tracked_* fields are filled. 0: this one gave no valid temperature.
int filter_block(const struct filter_params *p, struct filter_state *s, struct coil_block *block);

#endif
