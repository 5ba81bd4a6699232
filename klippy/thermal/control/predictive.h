#ifndef CHELPER_MODELLAW_H
#define CHELPER_MODELLAW_H
// The predictive law: what the filter knows, carried forward to when an output holds, and the output that fits.
// Explained in klippy/thermal/control/predictive.py.

#include "predictive_filter.h"

// Outputs nearer than this (of full output) are one and the same step.
#define SAME_SHARE 0.004
// Nearer than this to the reference, and not about to change: no horizon is worth sending.
#define SETTLED_C 0.25
// A reading that has swung by at least this for so long, with the estimate within so many swings and not farther than
// this: its mean is brought to the wanted temperature within RIDDEN_S, up to a limit. A single disturbance ends sooner.
#define RIDDEN_C 0.5
#define RIDDEN_AFTER_S 2.0
#define RIDDEN_SWINGS 6.0
#define RIDDEN_NEAR_C 10.0
#define RIDDEN_S 1.0
#define RIDDEN_MAX_C 4.0
#define SETTLED_MM3_S 0.2 // the flow at the nozzle still follows that of the motor when farther from it than this
#define SINGLE_STEPS 6    // of the plan; the later ones are twice as long
#define PIECE_S 0.02      // flow and fan are looked at so often
#define HOLDING_SHARE 0.05 // of full output: a plan's last output above holding power by this much ends in that

enum { MODEL_HORIZON = 64 };

// control_api.ControlInput; NaN and NULL where that has NaN and None
struct model_inputs {
    double time_s, reference_c, measured_c, limit, sigma_c, applied, apply_s;
    int32_t is_rebased;
    int32_t is_alone;                           // the caller does not know what is pending: it is what the law remembers
    int32_t sample_count, pending_count;
    const struct model_sample *samples;
    const struct model_planned *pending;
    const struct model_line *reference, *flow, *fan;
    double ridden_c; // model_state's, added to what is wanted
};

// control_api.ControlOutput
struct model_output {
    double value, unlimited, proportional, integral, derivative, feedforward, predicted_c;
    int32_t horizon_count;
    struct model_planned horizon[MODEL_HORIZON];
};

// One step; `after` may be `before`.
void model_step(const struct model_params *p, const struct model_state *before, const struct model_inputs *in,
                struct model_state *after, struct model_output *out);
// Somebody else's output; a filter that knows nothing begins at `seen` (NULL: nothing seen); `output` holds it there.
void model_follow(const struct model_params *p, struct model_state *s, const struct model_sample *seen,
                  const struct model_line *flow, const struct model_line *fan, double output);

#endif
