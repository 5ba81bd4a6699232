#ifndef CHELPER_CLOCKFIT_H
#define CHELPER_CLOCKFIT_H
// The widest strip between the upper and lower bounds that answers to get_clock set; theory: klippy/link/clockfit.py.

#include <stdint.h>

struct clock_sample {
    double sent_s, received_s;
    int64_t clock;
};

// y = offset_s + slope x + curvature x^2/2, x the time since the last sample; doubt_s: of the offset.
struct strip_fit {
    double offset_s, slope, doubt_s;
};

enum { CLOCKFIT_ROOM = 8 }; // doubles of room for each sample

// `samples` oldest first, at least one; `room` of CLOCKFIT_ROOM * count doubles is overwritten.
struct strip_fit clockfit_strip(const struct clock_sample *samples, int count, double nominal_freq, double curvature,
                                double floor_s, double crystal_sigma, double *room);

#endif
