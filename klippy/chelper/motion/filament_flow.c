// Planned flow of an extruder. See filament_flow.h.

#include "filament_flow.h"
#include <math.h>

#define GAP_S 1e-6 // spans farther apart stand still between

void
filament_flow_reset(struct filament_flow *f)
{
    f->peak_mm = -1e9;
    f->count = 0;
}

// Length of new filament over a span; the peak is moved on.
static double
new_filament(const struct trapq_span *span, double *peak_mm)
{
    double length_mm = span->x_r * (span->start_v + 0.5 * span->accel * span->duration) * span->duration;
    if (span->start_x < *peak_mm - RETRACT_MAX_MM)
        *peak_mm = span->start_x; // another origin
    double end_mm = span->start_x + length_mm, new_mm = fmax(0.0, fmin(length_mm, end_mm - *peak_mm));
    *peak_mm = fmax(*peak_mm, end_mm);
    return new_mm;
}

int
filament_flow_look(struct filament_flow *f, const struct trapq *tq, double start_s, double end_s, double area_mm2,
                   double *times_s, double *flows)
{
    struct trapq_span spans[FLOW_SPANS_MAX];
    int count = trapq_extract(tq, spans, FLOW_SPANS_MAX, start_s, end_s);
    if (!count)
        return 0;
    for (int i = 0; i < f->count; i++)
        if (f->end_s[i] <= start_s)
            f->peak_mm = f->peaks_mm[i];
    double peak_mm = f->peak_mm, flow = 0.0, until_s = start_s;
    int steps = 0;
    for (int i = 0; i < count; i++) {
        const struct trapq_span *span = &spans[i];
        double new_mm = new_filament(span, &peak_mm);
        f->end_s[i] = span->print_time + span->duration;
        f->peaks_mm[i] = peak_mm;
        double mean = span->duration > 0.0 ? new_mm / span->duration * area_mm2 : 0.0;
        mean = mean > FLOW_MIN ? mean : 0.0;
        if (span->print_time > until_s + GAP_S && flow != 0.0) {
            times_s[steps] = until_s;
            flows[steps++] = flow = 0.0;
        }
        if (fabs(mean - flow) > SAME_FLOW_SHARE * flow) {
            times_s[steps] = span->print_time;
            flows[steps++] = flow = mean;
        }
        until_s = f->end_s[i];
    }
    f->count = count;
    if (flow != 0.0) {
        times_s[steps] = until_s;
        flows[steps++] = 0.0;
    }
    return steps;
}
