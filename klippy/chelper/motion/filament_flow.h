#ifndef CHELPER_FILAMENT_FLOW_H
#define CHELPER_FILAMENT_FLOW_H
// The flow that an extruder's queue of moves will make, as steps over time. Retracted filament that returns is no flow.

#include "trapq.h"
#include <stdint.h>

#define RETRACT_MAX_MM 50.0 // farther back it is another origin
#define FLOW_MIN 0.01       // mm^3/s; less is standing still
#define SAME_FLOW_SHARE 0.02 // neighbouring spans nearer than this are one

enum { FLOW_SPANS_MAX = 256, FLOW_STEPS_MAX = 2 * FLOW_SPANS_MAX + 1 };

// The filament's farthest place: before the spans of the last look, and at the end of each.
struct filament_flow {
    double peak_mm;
    int32_t count;
    double end_s[FLOW_SPANS_MAX], peaks_mm[FLOW_SPANS_MAX];
};

void filament_flow_reset(struct filament_flow *f);
// Flow from start_s to end_s, mm^3/s: flows[i] holds from times_s[i] to the next, none before the first. Returns how many.
int filament_flow_look(struct filament_flow *f, const struct trapq *tq, double start_s, double end_s, double area_mm2,
                       double *times_s, double *flows);

#endif
