#ifndef CHELPER_MODELFILTER_H
#define CHELPER_MODELFILTER_H
// Kalman filter of predictive control, around heater_model.h: temperatures, disturbance power, gain of the drive.
// Its equations: klippy/thermal/control/predictive_filter.py. What tunes every heater's filter alike stands here; what differs from
// heater to heater is in struct model_params.

#include "reference_line.h"
#include "thermal/models/heater_model.h"

#define GAIN_MIN 0.1
#define GAIN_MAX 10.0
// Samples of one innovation at most, some messages: one of a long batch would dilute what the newest say.
#define TOGETHER_MAX 7
// An innovation whose square is so many times its variance: the disturbance is taken to have changed ...
#define SURPRISE 14.0
#define SURPRISED_W 3.0 // ... by about this much at once.
// Innovations that lean one way: their sum, each in its own sigma and decaying so fast a message, is 1.5 by chance.
#define LEAN_KEEP 0.75
#define LEAN_MAX 4.0  // nearly three times that: the disturbance moves ...
#define LEAN_SHARE 0.5 // ... by about this much of disturbance_start_w a message.
// Farther off than this within a message no heat goes: the thermometer jumped, by about JUMPED_C.
#define JUMP_C 3.0
#define JUMP_SIGMA 6.0
#define JUMPED_C 10.0
#define REBASED_SIGMA 10.0 // a step of the drive may move the sensing law by this many of a sample's sigma
// Beyond this it has, and the reading is put right as long as the drive stays ...
#define OFFSET_C 1.0
#define OFFSET_SIGMA 4.0
#define OFFSET_SHARE 0.5 // ... above this share of what it was seen at: little drive is the truth.
// 1 sigma of nodes, share of the gain's doubt after taking over from another law.
#define TAKEN_C 1.0
#define TAKEN_GAIN 0.2
// The reading's slant with the drive walks by so much within a second, degC at full drive; what counts as usual drive,
// where the reading is taken for the truth, follows within this time.
#define SLANT_WALK_C 0.3
#define SLANT_USUAL_S 0.2
#define SLANT_GAIN 0.05 // it is learned once the drive's gain is known so well: before, a wrong gain passes for a slant
// Coloured errors of the reading (coloured_c2_s): a sample counts for the time since the one before, up to a limit.
#define COLOURED_GAP_S 0.02
// Innovations that swing to and fro by `swing_c` are vibration or interference: they add a density of swing_c^2 times
// this. A half wave ends where the sign changes and this share of its peak is passed; memory decays within this time.
#define SWING_S 0.006
#define SWING_SHARE 0.25
#define SWING_KEEP_S 1.0
#define SWING_DOUBT_C 5.0 // readings of more doubt than this do not show it
// With coloured errors gain and slant are learned above this share of full drive: below it a swing that moves the drive
// would pass for one. Then a jump of the thermometer begins at this much, beyond what interference does.
#define GAIN_SHARE 0.25
#define COLOURED_JUMP_C 12.0
#define SECOND_MARGIN_C 20.0 // the second mass lies between air and the hottest node, give or take this

enum {
    MODEL_PLACES = 7, // of the covariance at most, see struct model_places
    MODEL_SENT = 32,  // own outputs remembered; the oldest go
};

// control_api.Sample
struct model_sample {
    double time_s, end_s, temp_c, sigma_c, output;
    uint8_t is_rebased;
};

// control_api.Planned
struct model_planned {
    double time_s, value;
};

// model_filter.ModelState
struct model_state {
    double time_s;              // what the nodes belong to; NaN: nothing known yet
    struct model_nodes nodes;
    double disturbance_w, gain;
    double innovation_c;        // newest: measured minus expected
    double read_to_s;           // end of the newest piece with a measurement
    double read_s, read_cs;     // of the newest samples: time since those before, reading times time
    double measured_s;             // newest measurement
    double output;              // newest output decided
    double driven;              // output in force at the newest measurement
    double offset_c;            // taken off the readings ...
    double offset_output;       // ... since the output stepped to this
    double lean;                // decaying sum of innovations, each over its sigma
    double swing_c;             // amplitude of innovations that swing to and fro, the smaller of two half waves
    double swinging_s;          // for so long the reading has swung, see predictive.c
    double ridden_c;            // added to the wanted temperature while the reading swings, see predictive.c
    double half_c, before_c;    // peak of the present half wave, with sign, and size of the one before
    double slant_c;             // what full drive by itself adds to the reading
    double usual;               // share of full drive at which the reading is taken for the truth
    double covariance[MODEL_PLACES][MODEL_PLACES];  // of the nodes there are, see model_layout
    int32_t size;               // so many places are used
    int32_t nodes_known;        // which ones they are: those of another model say nothing
    int32_t sent_count;
    struct model_planned sent[MODEL_SENT];          // own outputs, where the caller does not know what is pending
};

// Places in the covariance; -1: no such node.
struct model_places {
    int element, temp, second, sensor, disturbance, gain, slant, size, measured;
    int nodes;  // which there are, as bits
};

struct model_places model_layout(const struct model_params *p);
// Nothing known yet.
void model_reset(struct model_state *s);
// Know one temperature; the drive's gain is kept, if it is known.
void model_begin(const struct model_params *p, struct model_state *s, double temp_c, double time_s);
// Just begun, with a known disturbance: it holds most of what was uncertain about gain and second mass.
void model_taken_over(const struct model_params *p, struct model_state *s, double disturbance_w);
// After these samples, in order of time; many are taken in pieces.
void model_observe(const struct model_params *p, struct model_state *s, const struct model_sample *samples, int count,
                   const struct model_line *flow, const struct model_line *fan);

#endif
