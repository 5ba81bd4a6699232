// A conventional heater with a thermistor: hotend or heated bed. Pure C, doubles; knows no MCU and no clock.
//
//   duty ─► element ─► body ─► air (+ fan, + melt)      sensor lags the body ─► thermistor ─► divider ─► ADC code
//
// Equations and origins: thermal_load.c. Same five verbs as plant.h: init, set (duty, inputs), advance, sample, read.
#ifndef FERRITE_SIM_THERMAL_LOAD_H
#define FERRITE_SIM_THERMAL_LOAD_H

#include <stdint.h>

#include "plant_noise.h"

// X(name, unit, hotend, bed, min, max, doc). [T5] Table 5 of Oskolkov 2021, conventional column, fitted;
// [assumed] engineering assumption: a 220 x 220 mm bed, 3 mm aluminium with a spring-steel sheet, 24 V 200 W.
// clang-format off
#define THERMAL_LOAD_TABLE(X)                                                                                    \
  X(ambient_c,        "degC",   22.5,   22.5,   -40,  100,  "air around it [T5]")                                   \
  X(start_c,          "degC",   22.5,   22.5,   -40,  500,  "temperature of everything at the start")               \
  X(heater_w,         "W",      40.0,   200.0,  0,    5000, "heater power at duty 1, 20 degC and nominal supply")   \
  X(heater_tempco,    "1/K",    0.0,    0.0,    -0.01, 0.01, "relative rise of the heater's resistance with temperature") \
  X(supply_factor,    "",       1.0,    1.0,    0,    2,    "supply voltage over nominal")                          \
  X(element_j_k,      "J/K",    2.0,    330.0,  0.01, 1e5,  "heat capacity of the part the heater sits in [T5; bed assumed]") \
  X(body_j_k,         "J/K",    15.0,   190.0,  0.01, 1e5,  "heat capacity of the rest (block; bed sheet) [T5; bed assumed]") \
  X(link_w_k,         "W/K",    0.5,    15.0,   1e-3, 1e4,  "element to body (hotend: cartridge tau 4 s) [bed assumed]") \
  X(loss_w_k,         "W/K",    0.07053,  0.8,  0,    1e3,  "body to air (hotend: 17 J/K over 241.5 s) [T5; bed assumed]") \
  X(element_loss_w_k, "W/K",    0.0,    0.4,    0,    1e3,  "element to air (bed: insulated underside) [assumed]")  \
  X(mass_factor,      "",       1.0,    1.0,    0.2,  5,    "scales both heat capacities")                          \
  X(loss_factor,      "",       1.0,    1.0,    0.2,  5,    "scales the losses")                                    \
  X(fan_w_k,          "W/K",    0.03,   0.1,    0,    100,  "added body loss with the part fan at full speed [assumed]") \
  X(melt_ua_w_k,      "W/K",    0.060,  0.0,    0,    10,   "body to melt; 0: nothing flows through (bed)")         \
  X(melt_heat_mj_m3k, "MJ/(m^3 K)", 2.1, 2.1,   0.1,  10,   "volumetric heat capacity of the filament")             \
  X(melt_in_c,        "degC",   25.0,   25.0,   -40,  300,  "filament temperature where it enters")                 \
  X(flow_tau_s,       "s",      0.020,  0.020,  0,    1,    "flow at the nozzle behind the motor [assumed]")        \
  X(sensor_tau_s,     "s",      1.5,    3.0,    1e-3, 100,  "thermistor behind the body [bed assumed]")             \
  X(sensor_gain,      "",       1.0,    1.0,    0,    2,    "share of the body's excess over air the sensor sees")  \
  X(thermistor_r25_ohm, "ohm",  100e3,  100e3,  1,    1e7,  "thermistor at 25 degC")                                \
  X(thermistor_beta_k,  "K",    3950,   3950,   100,  1e4,  "beta of R = R25 exp(beta (1/T - 1/298.15 K))")         \
  X(pullup_ohm,       "ohm",    4700,   4700,   1,    1e7,  "from the ADC pin to the reference")                    \
  X(inline_ohm,       "ohm",    0.0,    0.0,    0,    1e6,  "in series with the thermistor")                        \
  X(noise_lsb,        "LSB",    0.5,    0.5,    0,    1000, "Gaussian noise at the ADC, rms [assumed]")             \
  X(adc_max,          "LSB",    4095,   4095,   1,    65535, "highest code (12 bit)")                               \
  X(fault,            "",       0,      0,      0,    4,    "0 none, 1 sensor open, 2 sensor short, 3 heater broken, 4 heater stuck on")
// clang-format on

enum thermal_load_param_id {
#define THERMAL_LOAD_ID(name, unit, hotend, bed, lo, hi, doc) THERMAL_LOAD_##name,
    THERMAL_LOAD_TABLE(THERMAL_LOAD_ID)
#undef THERMAL_LOAD_ID
        THERMAL_LOAD_PARAM_COUNT
};

enum thermal_load_fault {
    THERMAL_LOAD_OK = 0,
    THERMAL_LOAD_SENSOR_OPEN = 1,
    THERMAL_LOAD_SENSOR_SHORT = 2,
    THERMAL_LOAD_HEATER_BROKEN = 3,
    THERMAL_LOAD_HEATER_STUCK = 4,
};

struct thermal_load_param {
    const char *name, *unit, *doc;
    double hotend, bed, min, max;
};
extern const struct thermal_load_param thermal_load_params[];
extern const int thermal_load_param_count;

struct thermal_load_values {
#define THERMAL_LOAD_FIELD(name, unit, hotend, bed, lo, hi, doc) double name;
    THERMAL_LOAD_TABLE(THERMAL_LOAD_FIELD)
#undef THERMAL_LOAD_FIELD
};

struct thermal_load {
    struct thermal_load_values v;
    double duty, flow_in, fan;
    double element_c, body_c, sensor_c, flow;
    double heater_j, lost_j, melt_j; // since the start
    struct noise_source noise;
};

struct thermal_load_outputs {
    double body_c, sensor_c, element_c, melt_c;
    double power_w; // from the heater
    double flow_mm3_s;
};

void thermal_load_init(struct thermal_load *l, const double *values, uint64_t seed);
struct thermal_load *thermal_load_new(void);
void thermal_load_free(struct thermal_load *l);
int thermal_load_param_index(const char *name); // -1 if there is no such parameter
void thermal_load_set_param(struct thermal_load *l, int index, double value);
double thermal_load_get_param(const struct thermal_load *l, int index);
void thermal_load_set_duty(struct thermal_load *l, double duty); // 0..1; a switched pin gives 0 or 1
void thermal_load_set_inputs(struct thermal_load *l, double flow_mm3_s, double fan);
void thermal_load_advance(struct thermal_load *l, double dt_s);
void thermal_load_sample(struct thermal_load *l, uint16_t *out, uint32_t n); // n readings of the ADC, now
void thermal_load_read(const struct thermal_load *l, struct thermal_load_outputs *out);

#endif
