// Predict, choose, plan. See predictive.h.

#include "predictive.h"
#include <math.h>

// The model run ahead from one state.
struct future {
    const struct model_params *p;
    const struct model_inputs *in;
    double gain, disturbance_w;
    struct model_nodes nodes;
    double time_s;
    struct model_nodes without, reached;    // one horizon on, with no output and with full output
};

static double
wanted_c(const struct model_inputs *in, double time_s)
{
    return in->ridden_c + (in->reference ? model_line_corner(in->reference, time_s) : in->reference_c);
}

// Temperature wanted of the controlled node at `time_s + dt_s`; `remaining`: share of a small deviation left by then.
static double
wanted_after(const struct model_params *p, const struct model_inputs *in, double temp_c, double time_s, double dt_s,
             double remaining)
{
    double now_c = wanted_c(in, time_s), then_c = wanted_c(in, time_s + dt_s);
    return then_c - lesser(p->band_c, greater(-p->band_c, now_c - temp_c)) * remaining;
}

// The nodes after `dt_s` of one output. Surroundings are taken at the middle of each piece.
static void
run_on(const struct future *f, struct model_nodes *nodes, double output, double start_s, double dt_s)
{
    double longest_s = greater(f->p->hold_s, PIECE_S);
    double pieces = dt_s <= longest_s ? 1.0 : ceil(dt_s / longest_s - 1e-6), piece_s = dt_s / pieces;
    struct model_drive drive = {output, f->gain, f->disturbance_w};
    for (double i = 0.0; i < pieces; i++) {
        double middle_s = start_s + (i + 0.5) * piece_s;
        double flow = model_line_step(f->in->flow, middle_s), fan = model_line_step(f->in->fan, middle_s);
        model_advance(f->p, nodes, &drive, flow, fan, piece_s);
    }
}

static void
hold(struct future *f, double output, double dt_s)
{
    if (!(dt_s > 0.0))
        return;
    run_on(f, &f->nodes, output, f->time_s, dt_s);
    f->time_s += dt_s;
}

// Move on through outputs already decided; `output` was in force before them.
static void
go_through(struct future *f, const struct model_planned *decided, int count, double output, double until_s)
{
    for (const struct model_planned *d = decided; d < decided + count; d++) {
        hold(f, output, lesser(d->time_s, until_s) - f->time_s);
        output = d->value;
    }
    hold(f, output, until_s - f->time_s);
}

// Unlimited output from now on: how far no output and full output bring the nodes within the horizon, and between them.
static double
choose(struct future *f, double full)
{
    const struct model_params *p = f->p;
    double target_c = wanted_after(p, f->in, f->nodes.temp_c, f->time_s, p->prediction_s, p->remaining);
    f->without = f->reached = f->nodes;
    run_on(f, &f->without, 0.0, f->time_s, p->prediction_s);
    run_on(f, &f->reached, full, f->time_s, p->prediction_s);
    double reach_c = f->reached.temp_c - f->without.temp_c;
    return reach_c > 1e-9 ? full * (target_c - f->without.temp_c) / reach_c : 0.0;
}

// Within the power's range, the step's limit and the slew rate.
static double
limited(const struct model_params *p, const struct model_inputs *in, double value, double before, double hold_s)
{
    double step = p->slew_per_s * hold_s;
    double high = lesser(lesser(p->output_high, in->limit), before + step);
    return greater(greater(0.0, before - step), lesser(high, value));
}

// Nothing is going to happen within the horizon that a single output does not do.
static int
is_unchanging(const struct future *f)
{
    const struct model_params *p = f->p;
    const struct model_inputs *in = f->in;
    double now_s = f->time_s, end_s = now_s + (p->ahead + 1) * p->prediction_s, now_c = wanted_c(in, now_s);
    if (fabs(now_c - f->nodes.temp_c) >= SETTLED_C)
        return 0;
    if (in->reference) {
        int last = model_line_passed(in->reference, end_s) + 1;
        if (last > in->reference->count)
            last = in->reference->count;
        for (int i = model_line_passed(in->reference, now_s); i < last; i++)
            if (in->reference->at[in->reference->count + i] != now_c)
                return 0;
    }
    if (fabs(model_line_step(in->flow, now_s) - f->nodes.flow) >= SETTLED_MM3_S)
        return 0;
    return model_line_passed(in->flow, now_s) == model_line_passed(in->flow, end_s)
           && model_line_passed(in->fan, now_s) == model_line_passed(in->fan, end_s);
}

static void
say(struct model_output *out, double time_s, double value)
{
    if (out->horizon_count < MODEL_HORIZON)
        out->horizon[out->horizon_count++] = (struct model_planned){time_s, value};
}

// One stride of the plan; the output for it, which follows `output`.
static double
plan_stride(struct future *f, const struct model_nodes *added, double output, double strides)
{
    const struct model_params *p = f->p;
    double reach_c = greater(added->temp_c, 1e-12), dt_s = strides * p->prediction_s;
    double remaining = strides > 1.0 ? p->remaining * p->remaining : p->remaining;
    double target_c = wanted_after(p, f->in, f->nodes.temp_c, f->time_s, dt_s, remaining);
    hold(f, output, dt_s);
    double wanted = output + (target_c - f->nodes.temp_c) / (strides * reach_c);
    double change = limited(p, f->in, wanted, output, p->prediction_s) - output;
    if (change)
        model_nodes_add(&f->nodes, change * strides, added);
    return output + change;
}

// What follows the first output, as far as it differs; ends holding the wanted temperature. What comes later will
// probably be replaced: those strides are twice as long.
static void
plan(struct future *f, double first, struct model_output *out)
{
    const struct model_params *p = f->p;
    double full = p->output_high, output = first, said = first;
    struct model_nodes added = model_nodes_per(&f->reached, &f->without, full);
    hold(f, output, p->prediction_s);
    int doubles = p->ahead > SINGLE_STEPS - 1 ? (p->ahead - SINGLE_STEPS + 1) / 2 : 0;
    for (int i = 0; i < p->ahead - doubles; i++) {
        double start_s = f->time_s;
        output = plan_stride(f, &added, output, i < p->ahead - 2 * doubles ? 1.0 : 2.0);
        if (fabs(output - said) > SAME_SHARE * full) {
            say(out, start_s, output);
            said = output;
        }
    }
    double end_s = f->time_s, end_c = wanted_c(f->in, end_s);
    double power_w = model_hold_w(p, end_c, model_line_step(f->in->flow, end_s), model_line_step(f->in->fan, end_s));
    power_w -= f->disturbance_w;
    double holding = greater(0.0, power_w / (model_heat_per_output_w(p, end_c) * f->gain));
    if (said > holding + HOLDING_SHARE * full)
        say(out, end_s, lesser(holding, said));
}

// The step's measurements where none are listed: one reading, since which the law's own outputs were in force unless
// the caller says which one was. Returns how many samples that makes.
static int
make_samples(const struct model_state *s, const struct model_inputs *in, struct model_sample *made)
{
    double time_s = in->time_s, sigma_c = in->sigma_c > 0.0 ? in->sigma_c : 0.0, output = in->applied;
    int count = 0;
    if (output != output) {
        output = s->sent_count ? s->sent[0].value : s->output;
        for (const struct model_planned *d = s->sent; d < s->sent + s->sent_count && d->time_s < time_s; d++) {
            if (d->time_s > s->time_s)
                made[count++] = (struct model_sample){d->time_s, d->time_s, NAN, 0.0, output, 0};
            output = d->value;
        }
    }
    made[count++] = (struct model_sample){time_s, time_s, in->measured_c, sigma_c, output, in->is_rebased != 0};
    return count;
}

// Keep own outputs that still matter: the one in force at `time_s` and all later ones.
static void
remember(struct model_state *s, const struct model_inputs *in, double from_s, double value)
{
    if (!in->is_alone) {
        s->sent_count = 0;
        return;
    }
    struct model_planned sent[MODEL_SENT + 1];
    int count = 0, start = 0;
    for (int i = 0; i < s->sent_count; i++)
        sent[count++] = s->sent[i];
    sent[count++] = (struct model_planned){from_s, value};
    for (int i = 0; i < count; i++)
        if (sent[i].time_s <= in->time_s)
            start = i;
    if (count - start > MODEL_SENT)
        start = count - MODEL_SENT;
    s->sent_count = count - start;
    for (int i = 0; i < s->sent_count; i++)
        s->sent[i] = sent[start + i];
}

// From a known state to the output that holds from `apply_s` on.
static void
decide(const struct model_params *p, const struct model_state *s, const struct model_inputs *in, double before,
       double apply_s, struct model_output *out)
{
    struct model_inputs ridden = *in;
    ridden.ridden_c = s->ridden_c;
    in = &ridden;
    struct future f = {.p = p, .in = in, .gain = s->gain, .disturbance_w = s->disturbance_w, .nodes = s->nodes,
                       .time_s = s->time_s};
    if (in->is_alone)
        go_through(&f, s->sent, s->sent_count, before, apply_s);
    else
        go_through(&f, in->pending, in->pending_count, before, apply_s);
    double at_c = out->predicted_c = f.nodes.temp_c;
    out->unlimited = choose(&f, p->output_high);
    out->value = limited(p, in, out->unlimited, s->output, p->hold_s);
    double per_output_w = model_heat_per_output_w(p, at_c) * s->gain;
    double lost_w = model_hold_w(p, at_c, model_line_step(in->flow, apply_s), model_line_step(in->fan, apply_s));
    out->feedforward = lost_w / per_output_w;
    out->integral = -s->disturbance_w / per_output_w;
    out->proportional = out->unlimited - out->feedforward - out->integral;
    if (!p->ahead || is_unchanging(&f))
        return;
    plan(&f, out->value, out);
}

// While the reading swings, an output that is cut at zero moves the mean of the estimate and of the nozzle: it heats faster
// than it cools. The mean of the reading moves with that of the nozzle. What it is off by is added to what is wanted.
static void
ride(const struct model_params *p, struct model_state *s, const struct model_inputs *in)
{
    double now_c = wanted_c(in, s->time_s), share = lesser(1.0, s->read_s / RIDDEN_S);
    int swings = p->coloured_c2_s && s->swing_c >= RIDDEN_C;
    int is_near = fabs(now_c - s->nodes.temp_c) <= lesser(RIDDEN_NEAR_C, RIDDEN_SWINGS * s->swing_c);
    s->swinging_s = swings && is_near ? s->swinging_s + s->read_s : 0.0;
    if (!swings)
        s->ridden_c -= share * s->ridden_c;
    else if (s->swinging_s >= RIDDEN_AFTER_S)
        s->ridden_c = bounded(s->ridden_c + (now_c * s->read_s - s->read_cs) / RIDDEN_S, RIDDEN_MAX_C);
}

void
model_step(const struct model_params *p, const struct model_state *before, const struct model_inputs *in,
           struct model_state *after, struct model_output *out)
{
    struct model_sample made[MODEL_SENT + 1];
    const struct model_sample *samples = in->samples;
    int count = in->sample_count;
    if (!count) {
        count = make_samples(before, in, made);
        samples = made;
    }
    if (after != before)
        *after = *before;
    model_observe(p, after, samples, count, in->flow, in->fan);
    double apply_s = in->apply_s == in->apply_s ? in->apply_s : in->time_s + p->delay_s;
    *out = (struct model_output){.predicted_c = NAN};
    if (after->time_s == after->time_s && in->reference_c > 0.0) {
        ride(p, after, in);
        decide(p, after, in, samples[count - 1].output, apply_s, out);
    }
    remember(after, in, apply_s, out->value);
    after->output = out->value;
}

void
model_follow(const struct model_params *p, struct model_state *s, const struct model_sample *seen,
             const struct model_line *flow, const struct model_line *fan, double output)
{
    s->output = output;
    if (s->time_s == s->time_s || !seen)
        return;
    static const struct model_line idle = {0};
    double lost_w = model_hold_w(p, seen->temp_c, model_line_step(flow, seen->end_s), model_line_step(fan, seen->end_s));
    double unknown_w = lost_w - output * model_heat_per_output_w(p, seen->temp_c);
    model_observe(p, s, seen, 1, &idle, &idle);
    model_taken_over(p, s, unknown_w);
    s->output = seen->output;
}
