#ifndef CHELPER_SENSINGLAW_H
#define CHELPER_SENSINGLAW_H
// Sensing laws: signal units of the coil at a bridge phase to the nozzle's temperature and back.
// Their equations and where they come from: klippy/thermal/sensing/laws.py, which also holds their coefficients.

#include <stdint.h>

enum sensing_kind { SENSING_EXP, SENSING_EQ5, SENSING_TANK };
enum { SENSING_COEFFICIENTS = 9, SENSING_LEVELS = 16, SENSING_NODES = 8 };

struct sensing_law {
    int32_t kind;
    double phase_max_ticks;                 // 180 degrees
    double k[SENSING_COEFFICIENTS];         // in the order of the fields in laws.py
    // Of the tank law: what is added to its temperature, bilinear over drive and temperature; levels 0: nothing.
    int32_t levels, nodes;
    double level_ticks[SENSING_LEVELS], node_c[SENSING_NODES], added_c[SENSING_LEVELS][SENSING_NODES];
    double error_c[SENSING_LEVELS];         // what is left then, 1 sigma
};

struct sensing_reading {
    double temp_c;                          // NaN: the law has no answer
    double c_per_unit;                      // dT/derror, likewise
    double error_c;                         // 1 sigma of the law's own error at this drive, where a table knows it
};

// `supply`: the bridge's voltage over the one the law was taken at.
double sensing_error(const struct sensing_law *law, double temp_c, double phase_ticks, double supply);
struct sensing_reading sensing_invert(const struct sensing_law *law, double error, double phase_ticks, double supply);
// The law's one drifting number as it must be for `error` at this phase to read `temp_c`.
double sensing_rezeroed(const struct sensing_law *law, double temp_c, double error, double phase_ticks, double supply);

#endif
