#ifndef CHELPER_MODELLINE_H
#define CHELPER_MODELLINE_H
// A quantity over time, as klippy/thermal/control/control_api.py has it: Schedule (steps) or Reference (straight lines).

#include <stdint.h>

struct model_line {
    int32_t count;
    double before;      // steps: until the first time
    double at[];        // `count` times in s, ascending, then as many values
};

// From `count` pairs of a time and a value.
void model_line_fill(struct model_line *line, const double *pairs);
// How many of the times are not after `time_s`.
int model_line_passed(const struct model_line *line, double time_s);
// The value that has held since the newest step; `before` the first.
double model_line_step(const struct model_line *line, double time_s);
// On the straight line between two corners (at least one); the first and the last are held beyond.
double model_line_corner(const struct model_line *line, double time_s);

#endif
