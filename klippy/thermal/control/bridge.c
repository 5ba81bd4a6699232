// Commands of the bridge from a power request. See bridge.h.

#include "bridge.h"
#include "thermal/models/physics.h"
#include "thermal/sensing/pipeline.h"
#include <math.h>
#include <string.h>

#define BLOCK_SLACK 1e-6 // of a block: an edge so near is this one

void
timeline_reset(struct timeline *t)
{
    t->edge_s = -INFINITY;
    t->head = t->commands[0] = (struct phase_command){-INFINITY, 0, 0.0};
    t->count = 1;
}

void
timeline_note(struct timeline *t, const struct phase_command *commands, int count, double now_s)
{
    if (!count)
        return;
    t->head = commands[0];
    int kept = 0, past = 0;
    while (kept < t->count && t->commands[kept].time_s < commands[0].time_s - TIME_SLACK_S)
        kept++;
    while (past < kept && t->commands[past].time_s <= now_s - KEEP_S)
        past++;
    int first = past > 1 ? past - 1 : 0;
    if (kept - first + count > TIMELINE_MAX)
        first = kept + count - TIMELINE_MAX;
    memmove(t->commands, t->commands + first, (kept - first) * sizeof(*commands));
    memcpy(t->commands + kept - first, commands, count * sizeof(*commands));
    t->count = kept - first + count;
}

const struct phase_command *
timeline_last_before(const struct timeline *t, double time_s)
{
    const struct phase_command *c = t->commands + t->count - 1;
    while (c > t->commands && !(c->time_s < time_s))
        c--;
    return c;
}

int
timeline_is_on_from(const struct timeline *t, double time_s)
{
    if (timeline_last_before(t, time_s + TIME_SLACK_S)->phase_ticks)
        return 1;
    for (int i = 0; i < t->count; i++)
        if (t->commands[i].time_s > time_s && t->commands[i].phase_ticks)
            return 1;
    return 0;
}

const struct phase_command *
timeline_at(const struct timeline *t, double time_s)
{
    for (int i = t->count - 1; i >= 0; i--)
        if (t->commands[i].time_s <= time_s + TIME_SLACK_S)
            return t->commands[i].time_s >= time_s - TIME_SLACK_S ? &t->commands[i] : NULL;
    return NULL;
}

double
timeline_strongest_w(const struct timeline *t, double from_s, double until_s)
{
    double strongest_w = 0.0;
    for (const struct phase_command *c = t->commands + t->count - 1; c >= t->commands; c--) {
        if (c->time_s < until_s)
            strongest_w = greater(strongest_w, c->power_w);
        if (c->time_s <= from_s)
            return strongest_w;
    }
    return NAN;
}

int
timeline_pending(const struct timeline *t, double after_s, double until_s, struct model_planned *out)
{
    int count = 0;
    for (const struct phase_command *c = t->commands; c < t->commands + t->count; c++)
        if (after_s <= c->time_s && c->time_s < until_s)
            out[count++] = (struct model_planned){c->time_s, c->power_w};
    return count;
}

int
timeline_differs(const struct timeline *t, const struct model_planned *plan, int count, double by_w)
{
    for (int i = 0; i < count; i++)
        if (fabs(timeline_last_before(t, plan[i].time_s + TIME_SLACK_S)->power_w - plan[i].value) > by_w)
            return 1;
    int at = 0;
    for (const struct phase_command *c = t->commands; c < t->commands + t->count; c++) {
        if (!(c->time_s > plan[0].time_s + TIME_SLACK_S))
            continue;
        while (at + 1 < count && plan[at + 1].time_s <= c->time_s + TIME_SLACK_S)
            at++;
        if (fabs(c->power_w - plan[at].value) > by_w)
            return 1;
    }
    return 0;
}

double
timeline_edge(const struct timeline *t, const struct bridge_timing *timing, double earliest_s)
{
    double edge_s = t->edge_s;
    const struct phase_command *before = timeline_last_before(t, earliest_s + TIME_SLACK_S);
    if (before->time_s > edge_s)
        edge_s = before->time_s + timing->settle_s;
    if (edge_s == -INFINITY)
        return earliest_s;
    double blocks = ceil((earliest_s - edge_s) / timing->block_s - BLOCK_SLACK);
    return edge_s + greater(0.0, blocks) * timing->block_s;
}

double
drive_phase_ticks(const struct actuator_params *p, double power_w)
{
    if (power_w <= 0.0)
        return 0.0;
    double amplitude = pow(lesser(1.0, power_w / p->power_max_w), 1.0 / p->exponent);
    return 2.0 * asin(amplitude) / M_PI * p->phase_max_ticks;
}

static struct phase_command
at_phase(const struct actuator_params *p, double time_s, int64_t phase)
{
    return (struct phase_command){time_s, phase,
                                  drive_power_w(p->power_max_w, p->exponent, p->phase_max_ticks, phase)};
}

void
actuator_reset(struct actuator_state *s)
{
    *s = (struct actuator_state){.last_s = -INFINITY, .last_excited_s = -INFINITY, .look_s = -INFINITY,
                                  .hold_look_s = -INFINITY};
}

// Add the request of the interval that ends now. Continuous drive delivers what is requested.
static void
account(const struct actuator_params *p, struct actuator_state *s, double time_s)
{
    if (s->driving) {
        s->last_excited_s = time_s;
        s->owed_j = 0.0;
    } else if (s->last_s > -INFINITY) {
        s->owed_j += s->request_w * (time_s - s->last_s);
    }
    double limit_j = 2.0 * p->pulses_max * p->power_low_w * p->pulse_s;
    s->owed_j = lesser(limit_j, greater(-limit_j, s->owed_j));
}

// Length of the pulse that is due for the sake of measuring; 0: none is.
static double
sensing_s(const struct actuator_params *p, enum sensing_need need, double since_s)
{
    if (need == SENSE_WATCH && p->look_s > 0.0)
        return since_s >= p->watch_interval_s - TIME_SLACK_S ? p->look_s : 0.0;
    return since_s >= (need == SENSE_IDLE ? p->idle_interval_s : p->sense_interval_s) ? p->pulse_s : 0.0;
}

int
actuator_act(const struct actuator_params *p, struct actuator_state *s, double power_w, double time_s, int is_on,
             enum sensing_need need, struct phase_command *out)
{
    account(p, s, time_s);
    s->last_s = time_s;
    s->request_w = greater(0.0, power_w);
    int64_t phase = (int64_t)rint(drive_phase_ticks(p, power_w));
    s->driving = phase >= p->phase_low_ticks;
    if (s->driving) {
        out[0] = at_phase(p, time_s, phase);
        return 1;
    }
    double pulse_j = p->power_low_w * p->pulse_s, pulses = lesser(p->pulses_max, floor(s->owed_j / pulse_j + 0.5));
    double length_s = pulses >= 1.0 ? pulses * p->pulse_s : sensing_s(p, need, time_s - s->last_excited_s);
    out[0] = (struct phase_command){time_s, 0, 0.0};
    if (length_s == 0.0)
        return is_on ? 1 : 0;
    double end_s = time_s + length_s;
    s->owed_j -= p->power_low_w * length_s;
    s->last_excited_s = end_s;
    out[0] = (struct phase_command){time_s, p->phase_low_ticks, p->power_low_w};
    out[1] = (struct phase_command){end_s, 0, 0.0};
    return 2;
}

int
actuator_ahead(const struct actuator_params *p, const struct model_planned *horizon, int count,
               struct phase_command *out)
{
    struct phase_command *last = out;
    for (const struct model_planned *h = horizon; h < horizon + count; h++) {
        int64_t phase = (int64_t)rint(drive_phase_ticks(p, h->value));
        if (phase < p->phase_low_ticks)
            phase = h->value > 0.5 * p->power_low_w ? p->phase_low_ticks : 0;
        if (phase != last->phase_ticks && h->time_s > last->time_s)
            *++last = at_phase(p, h->time_s, phase);
    }
    return (int)(last - out);
}

// Begin with `phase` for `look_s`; what was to begin then follows.
static int
begin_with_look(const struct actuator_params *p, struct phase_command *commands, int count, int64_t phase, double look_s)
{
    struct phase_command after = commands[0], rest[PLAN_MAX];
    after.time_s += look_s;
    memcpy(rest, commands + 1, (count - 1) * sizeof(*rest));
    commands[0] = at_phase(p, commands[0].time_s, phase);
    commands[1] = after;
    int made = 2;
    for (int i = 0; i < count - 1; i++)
        if (rest[i].time_s > after.time_s)
            commands[made++] = rest[i];
    return made;
}

static int
hold_look(const struct actuator_params *p, struct actuator_state *s, struct phase_command *commands, int count)
{
    double start_s = commands[0].time_s, since_s = start_s - s->hold_look_s;
    if (!p->hold_looks || p->hold_look_s == 0.0 || p->look_s == 0.0 || !commands[0].phase_ticks
        || (0.0 < since_s && since_s < p->hold_look_s))
        return count;
    if (since_s != 0.0)
        s->hold_look = (s->hold_look + 1) % p->hold_looks;
    s->hold_look_s = start_s;
    if (!s->driving) { // the pulse keeps its length
        commands[1].time_s += p->look_s;
        s->last_excited_s = commands[1].time_s;
    }
    count = begin_with_look(p, commands, count, p->hold_look_ticks[s->hold_look], p->look_s);
    s->owed_j -= commands[0].power_w * p->look_s;
    return count;
}

int
actuator_look(const struct actuator_params *p, struct actuator_state *s, double rate_k_s, double doubt_c,
              struct phase_command *commands, int count)
{
    struct phase_command first = commands[0];
    if (!(pow(first.phase_ticks / p->phase_max_ticks, 2.0) >= LOOK_SHARE))
        return hold_look(p, s, commands, count);
    double apart_s = lesser(LOOK_MAX_S, greater(LOOK_MIN_S, LOOK_C / greater(1e-3, rate_k_s)));
    double since_s = first.time_s - s->look_s;
    if (p->look_s == 0.0 || (0.0 < since_s && since_s < (doubt_c > LOOK_DOUBT_C ? 0.0 : apart_s)))
        return count;
    s->look_s = first.time_s;
    return begin_with_look(p, commands, count, p->phase_low_ticks, apart_s >= LOOK_RARE_S ? p->long_look_s : p->look_s);
}

double
bridge_slot(const struct bridge_params *p, const struct timeline *t, double now_s, double apart_s)
{
    const struct bridge_timing *timing = &p->timing;
    double after_s = lesser(apart_s, timing->control_s) - TIME_SLACK_S;
    if (!p->plans) {
        double at_s = timeline_edge(t, timing, now_s + timing->lead_s);
        double taken_s = t->commands[t->count - 1].time_s + greater(TIME_SLACK_S, after_s);
        return at_s > taken_s ? at_s : NAN;
    }
    // A new target need not wait for a late host: late, it holds from its arrival on.
    double earliest_s = now_s + (apart_s > 0.0 ? timing->lead_s : lesser(timing->lead_s, p->prompt_s));
    double settled_s = timeline_last_before(t, earliest_s)->time_s;
    return timeline_edge(t, timing, greater(earliest_s, settled_s + after_s));
}

// Is it worth a message to replace what was sent for this place? Pulses are certain and stay.
static int
improves(const struct bridge_params *p, const struct bridge_state *s, const struct phase_command *taken,
         double power_w, const struct model_planned *horizon, int count)
{
    if (!p->plans || !s->actuator.driving || power_w < p->actuator.power_low_w || !taken->phase_ticks)
        return 0;
    struct model_planned plan[PLAN_MAX];
    plan[0] = (struct model_planned){taken->time_s, power_w};
    memcpy(plan + 1, horizon, count * sizeof(*horizon));
    return timeline_differs(&s->line, plan, 1 + count, p->resend_w);
}

int
bridge_command(const struct bridge_params *p, struct bridge_state *s, const struct bridge_request *r,
               struct phase_command *out)
{
    double at_s = bridge_slot(p, &s->line, r->now_s, r->apart_s);
    if (at_s != at_s)
        return 0;
    int is_off = !(r->target_c > 0.0), horizon = is_off ? 0 : r->horizon_count;
    double power_w = is_off ? 0.0 : r->power_w, age_s = r->now_s - r->estimate_s;
    if (power_w > 0.0 && !(age_s <= p->timing.stale_s + (s->actuator.driving ? 0.0 : p->actuator.idle_interval_s))) {
        power_w = p->actuator.power_low_w;
        horizon = 0;
    }
    const struct phase_command *taken = timeline_at(&s->line, at_s);
    if (taken && r->apart_s > 0.0 && !improves(p, s, taken, power_w, r->horizon, horizon))
        return 0;
    // On a line that loses the blocks of pulses the next pulse comes sooner.
    int arrives = age_s <= p->actuator.idle_interval_s + p->pulse_delay_s;
    enum sensing_need need = !is_off ? SENSE_WATCH : arrives ? SENSE_IDLE : SENSE_LOST;
    // A horizon may turn on again a bridge that is off; a pulse ends by itself and stays.
    int is_on = timeline_is_on_from(&s->line, greater(at_s, s->actuator.last_excited_s));
    int count = actuator_act(&p->actuator, &s->actuator, power_w, at_s, is_on, need, out);
    if (count == 1) {
        struct model_planned late = {at_s + p->timing.control_s, power_w}; // between pulses, if the host is late
        int is_planned = horizon && r->horizon[0].time_s <= late.time_s;
        if (p->plans && power_w > 0.0 && !out[0].phase_ticks && !is_planned)
            count += actuator_ahead(&p->actuator, &late, 1, out);
        count += actuator_ahead(&p->actuator, r->horizon, horizon, out + count - 1);
    }
    struct phase_command head = out[0];
    if (count && p->drive && power_w > 0.0) {
        double heat_j_k = p->heat_25c_j_k * (1.0 + p->heat_slope_per_k * (r->estimate_c - 25.0));
        double doubt_c = sqrt(p->drive->variance + p->drive->ripple_c2);
        count = actuator_look(&p->actuator, &s->actuator, power_w / heat_j_k, doubt_c, out, count);
    }
    timeline_note(&s->line, out, count, r->now_s);
    if (count)
        s->line.head = head;
    return count;
}

int
bridge_step(const struct bridge_params *p, struct bridge_state *s, const struct model_params *law,
            const struct model_state *before, const struct bridge_inputs *in, struct model_state *after,
            struct model_output *found, struct phase_command *out)
{
    const struct model_sample *newest = in->sample_count ? &in->samples[in->sample_count - 1] : NULL;
    // From the newest block's centre on: its end and the command there differ by the rounding of clocks.
    double since_s = newest ? newest->time_s : s->line.edge_s;
    double apply_s = bridge_slot(p, &s->line, in->now_s, in->apart_s);
    struct model_planned pending[TIMELINE_MAX];
    struct model_inputs inputs = {
        .time_s = in->estimate_s, .reference_c = in->target_c, .measured_c = NAN, .sigma_c = NAN, .limit = in->limit_w,
        .applied = newest ? newest->output : timeline_last_before(&s->line, since_s)->power_w, .apply_s = apply_s,
        .sample_count = in->sample_count, .samples = in->samples, .pending = pending,
        .reference = in->reference, .flow = in->flow, .fan = in->fan,
    };
    inputs.pending_count = timeline_pending(&s->line, since_s - TIME_SLACK_S, apply_s - TIME_SLACK_S, pending);
    model_step(law, before, &inputs, after, found);
    struct bridge_request request = {in->now_s, in->apart_s, in->target_c, found->value, in->estimate_s, in->estimate_c,
                                     found->horizon, found->horizon_count};
    return bridge_command(p, s, &request, out);
}
