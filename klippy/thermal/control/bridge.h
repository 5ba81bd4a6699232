#ifndef THERMAL_BRIDGE_H
#define THERMAL_BRIDGE_H
// A power request to commands of the bridge: where the next one may begin, what it is, and whether it is worth sending.
// Explained in actuator.py, timeline.py and bridge_driver.py of klippy/thermal/control.

#include "predictive.h"
#include "thermal/sensing/drive_offset.h"

#define TIME_SLACK_S 1e-7   // rounding of print times against clocks, far below a bridge period
#define LOOK_SHARE 0.05     // of full power: a weaker drive is read without looks
// From look to look the nozzle rises by this much, within these times. A look of 0.3 ms each 33 ms costs 1 % of
// power, each 8 ms 4 %: a nozzle that rises by 1000 K/s has one in each command.
#define LOOK_C 6.0
#define LOOK_MIN_S 0.006
#define LOOK_MAX_S 0.100
#define LOOK_RARE_S 0.050   // so far apart they may be long
#define LOOK_DOUBT_C 20.0   // more doubt about full drive than this: a look at each command
#define KEEP_S 0.4          // a block comes this late at most before the loop counts as blind

enum { TIMELINE_MAX = 512, PLAN_MAX = 3 + MODEL_HORIZON, HOLD_LOOKS_MAX = 4 };

// records.PhaseCommand
struct phase_command {
    double time_s;
    int64_t phase_ticks;
    double power_w;
};

// timeline.Timing
struct bridge_timing {
    double block_s, settle_s, lead_s, control_s, stale_s;
};

struct timeline {
    double edge_s;                              // an edge between two blocks; -infinity: none known
    struct phase_command head;                  // first of the newest plan
    int32_t count;                              // at least one: the newest that is surely in force, and all after it
    struct phase_command commands[TIMELINE_MAX];
};

struct actuator_params {
    double power_max_w, exponent, phase_max_ticks;  // drive law
    double power_low_w, pulse_s, sense_interval_s, idle_interval_s;
    double watch_interval_s;        // longest time without a measurement while a target is set; one takes look_s
    double look_s, long_look_s;     // at the sensing phase within a strong drive; 0: none
    double hold_look_s;             // from one look out of a weak drive, a pulse or idle to the next; 0: none
    int32_t phase_low_ticks, pulses_max;
    int32_t hold_looks, hold_look_ticks[HOLD_LOOKS_MAX];    // phases of those looks, in turn
};

// How often a bridge that need not heat measures: rarely and surely, more often, or shortly and all the time.
enum sensing_need { SENSE_IDLE, SENSE_LOST, SENSE_WATCH };

struct actuator_state {
    double last_s;          // start of the interval the last request holds for
    double request_w;       // request in force since last_s
    double owed_j;          // requested minus delivered
    double last_excited_s;  // end of the last pulse or continuous drive
    double look_s;          // start of the newest look at the sensing phase
    double hold_look_s;     // start of the newest look out of a weak drive ...
    int32_t hold_look;      // ... and its number
    int32_t driving;        // continuous drive (phase above the smallest) since last_s
};

struct bridge_params {
    struct bridge_timing timing;
    struct actuator_params actuator;
    double prompt_s;        // lead of a command that has to come soon
    double resend_w;        // a smaller change of what is already on its way is not worth a message
    double pulse_delay_s;   // from a sensing pulse until its blocks reach the host
    double heat_25c_j_k, heat_slope_per_k;  // heat_loss.HeatCapacity
    const struct drive_offset *drive;       // NULL: an uncalibrated law needs no looks
    int32_t plans;          // the law plans ahead: its next place may be filled anew by each message
};

struct bridge_state {
    struct timeline line;
    struct actuator_state actuator;
};

// What the bridge shall do, and what is known now.
struct bridge_request {
    double now_s, apart_s;  // at least so long after the last command; 0 for a new target
    double target_c, power_w, estimate_s, estimate_c;
    const struct model_planned *horizon;
    int32_t horizon_count;
};

// What the predictive law gets beside bridge_request's first fields; NULL: no reference.
struct bridge_inputs {
    double now_s, apart_s, target_c, limit_w, estimate_s, estimate_c;
    int32_t sample_count;
    const struct model_sample *samples;
    const struct model_line *reference, *flow, *fan;
};

void timeline_reset(struct timeline *t);
void timeline_note(struct timeline *t, const struct phase_command *commands, int count, double now_s);
const struct phase_command *timeline_last_before(const struct timeline *t, double time_s);
int timeline_is_on_from(const struct timeline *t, double time_s);
// NULL: none begins at this time.
const struct phase_command *timeline_at(const struct timeline *t, double time_s);
// Of the commands in force between the two times; NaN: they are not known.
double timeline_strongest_w(const struct timeline *t, double from_s, double until_s);
int timeline_pending(const struct timeline *t, double after_s, double until_s, struct model_planned *out);
int timeline_differs(const struct timeline *t, const struct model_planned *plan, int count, double by_w);
double timeline_edge(const struct timeline *t, const struct bridge_timing *timing, double earliest_s);

double drive_phase_ticks(const struct actuator_params *p, double power_w);
void actuator_reset(struct actuator_state *s);
// Commands into `out`, at most two.
int actuator_act(const struct actuator_params *p, struct actuator_state *s, double power_w, double time_s, int is_on,
                 enum sensing_need need, struct phase_command *out);
// What follows out[0], from out[1] on; returns how many.
int actuator_ahead(const struct actuator_params *p, const struct model_planned *horizon, int count,
                   struct phase_command *out);

// A strong drive begins with a look at the sensing phase, if one is due: where the reading is true. It shows by how much
// that of the strong drive is off (thermal/sensing/drive_offset.h). `doubt_c`: 1 sigma of what full drive adds to it.
// A weaker drive or pulse begins with a look at the next of hold_look_ticks, each hold_look_s, but not while idle. The heat
// of a look stands in the timeline, where the law's prediction finds it, and in owed_j.
int actuator_look(const struct actuator_params *p, struct actuator_state *s, double rate_k_s, double doubt_c,
                  struct phase_command *commands, int count);

// Where a command sent now may begin; NaN: it is too soon after the last.
double bridge_slot(const struct bridge_params *p, const struct timeline *t, double now_s, double apart_s);
// The commands to send, into `out` (PLAN_MAX); noted as sent.
int bridge_command(const struct bridge_params *p, struct bridge_state *s, const struct bridge_request *r,
                   struct phase_command *out);
// A step of the predictive law, and its commands.
int bridge_step(const struct bridge_params *p, struct bridge_state *s, const struct model_params *law,
                const struct model_state *before, const struct bridge_inputs *in, struct model_state *after,
                struct model_output *found, struct phase_command *out);

#endif
