// The model's state from the samples of a message. See predictive_filter.h.

#include "predictive_filter.h"
#include "thermal/models/physics.h"
#include <math.h>
#include <string.h>

#define SLOPES_MAX 11 // a model with all nodes

// A nonzero entry of A, the derivative of the model's rates by its state.
struct slope {
    int row, column;
    double per_s;
};

// What walking through the samples has given.
struct run {
    struct model_nodes nodes;
    double time_s;
    double weight;              // sum of 1/variance
    double own;                 // the same without coloured errors
    double pulled;              // of innovation times that
    double passed;              // of output times time
    double innovation_c;        // weighted mean
    double measured_s;
    double output;              // mean over the time walked
    double rebased_c;           // 1 sigma of what a step of the drive may have moved the reading, 0: there was none
    double driven, offset_c, offset_output;
    double levered;             // of lever times weight
    double lever;               // share of full drive beyond the usual, weighted mean
    double usual;
};

// Neighbours under one output, taken together at their weighted middle: the slope between them is a line.
struct group {
    int is_open;
    double end_s, output, weight, heat, moment;
};

static double
square(double x)
{
    return x * x;
}

static int
is_number(double x)
{
    return x == x;
}

struct model_places
model_layout(const struct model_params *p)
{
    int has_element = p->element_j_k > 0.0, has_second = p->second_j_k > 0.0, has_sensor = p->sensor_s > 0.0;
    struct model_places at = {.element = has_element - 1, .temp = has_element, .second = -1, .sensor = -1};
    int next = at.temp + 1;
    if (has_second)
        at.second = next++;
    if (has_sensor)
        at.sensor = next++;
    at.measured = has_sensor ? at.sensor : at.temp;
    at.disturbance = next++;
    at.gain = next++;
    at.slant = p->slant_c > 0.0 ? next++ : -1;
    at.size = next;
    at.nodes = has_element | has_second << 1 | has_sensor << 2 | (at.slant >= 0) << 3;
    return at;
}

void
model_reset(struct model_state *s)
{
    *s = (struct model_state){.time_s = NAN, .nodes = {NAN, NAN, NAN, NAN, NAN, 0.0}, .gain = 1.0, .measured_s = -INFINITY};
}

void
model_begin(const struct model_params *p, struct model_state *s, double temp_c, double time_s)
{
    struct model_places at = model_layout(p);
    double rise_c = fabs(temp_c - p->ambient_c), gain = 1.0, gain_variance = square(p->gain_start);
    if (is_number(s->time_s) && s->size) { // the last place but for a slant, also of another model's
        int last = s->size - 1 - (s->nodes_known >> 3);
        gain = s->gain;
        gain_variance = s->covariance[last][last];
    }
    memset(s->covariance, 0, sizeof(s->covariance));
    if (at.element >= 0)
        s->covariance[at.element][at.element] = square(5.0 + 0.1 * rise_c);
    s->covariance[at.temp][at.temp] = square(p->sigma_c + (p->sensor_s ? 0.1 * rise_c : 0.0));
    if (at.second >= 0)
        s->covariance[at.second][at.second] = square(2.0 + p->second_start * rise_c);
    if (at.sensor >= 0)
        s->covariance[at.sensor][at.sensor] = square(p->sigma_c);
    s->covariance[at.disturbance][at.disturbance] = square(p->disturbance_start_w);
    s->covariance[at.gain][at.gain] = gain_variance;
    if (at.slant >= 0)
        s->covariance[at.slant][at.slant] = square(p->slant_c);
    s->size = at.size;
    s->nodes_known = at.nodes;
    s->nodes = model_at_rest(p, temp_c);
    s->time_s = s->measured_s = s->read_to_s = time_s;
    s->gain = gain;
    s->disturbance_w = s->innovation_c = s->driven = s->offset_c = s->offset_output = s->lean = s->slant_c = 0.0;
    s->swing_c = s->swinging_s = s->half_c = s->before_c = s->ridden_c = 0.0;
    s->usual = s->output / p->output_high;
}

// Doubt about this place no more than `sigma`.
static void
trust(struct model_state *s, int place, double sigma)
{
    if (place >= 0)
        s->covariance[place][place] = lesser(s->covariance[place][place], sigma * sigma);
}

void
model_taken_over(const struct model_params *p, struct model_state *s, double disturbance_w)
{
    struct model_places at = model_layout(p);
    trust(s, at.temp, TAKEN_C);
    trust(s, at.second, TAKEN_C);
    trust(s, at.disturbance, p->disturbance_w);
    trust(s, at.gain, TAKEN_GAIN * p->gain_start);
    s->disturbance_w = bounded(disturbance_w, p->disturbance_max_w);
}

static int
find_slopes(const struct model_params *p, const struct model_places *at, const struct run *run, double fan,
            struct slope *out)
{
    const struct model_nodes *n = &run->nodes;
    double heat = model_capacity_j_k(p, n->temp_c), hot_k = n->temp_c + ZERO_CELSIUS_K;
    double air = p->loss_w_k + fan * p->fan_w_k + 4.0 * STEFAN_BOLTZMANN * p->radiation_m2 * pow(hot_k, 3.0);
    double taken = air + p->link_w_k + p->element_w_k + model_melt_w_k(p, n->flow);
    double drive_w = run->output * model_heat_per_output_w(p, n->temp_c);
    struct slope *next = out;
    *next++ = (struct slope){at->temp, at->temp, -taken / heat};
    *next++ = (struct slope){at->temp, at->disturbance, 1.0 / heat};
    if (at->element >= 0) {
        *next++ = (struct slope){at->element, at->element, -p->element_w_k / p->element_j_k};
        *next++ = (struct slope){at->element, at->temp, p->element_w_k / p->element_j_k};
        *next++ = (struct slope){at->element, at->gain, drive_w / p->element_j_k};
        *next++ = (struct slope){at->temp, at->element, p->element_w_k / heat};
    } else {
        *next++ = (struct slope){at->temp, at->gain, drive_w / heat};
    }
    if (at->second >= 0) {
        *next++ = (struct slope){at->temp, at->second, p->link_w_k / heat};
        *next++ = (struct slope){at->second, at->temp, p->link_w_k / p->second_j_k};
        *next++ = (struct slope){at->second, at->second, -(p->link_w_k + p->second_loss_w_k) / p->second_j_k};
    }
    if (at->sensor >= 0) {
        *next++ = (struct slope){at->sensor, at->sensor, -1.0 / p->sensor_s};
        *next++ = (struct slope){at->sensor, at->temp, 1.0 / p->sensor_s};
    }
    return (int)(next - out);
}

// P <- F P F' + Q over `dt_s`.
static void
spread(const struct model_params *p, const struct model_places *at, double rows[MODEL_PLACES][MODEL_PLACES],
       const struct slope *slopes, int slope_count, double dt_s)
{
    double steps = dt_s <= p->step_s ? 1.0 : ceil(dt_s / p->step_s), h = dt_s / steps;
    double walk = p->temp_walk_c * p->temp_walk_c * h, left[MODEL_PLACES][MODEL_PLACES];
    for (double step = 0.0; step < steps; step++) {
        memcpy(left, rows, sizeof(left));
        for (const struct slope *a = slopes; a < slopes + slope_count; a++) {
            double k = a->per_s * h;
            for (int c = 0; c < at->size; c++)
                left[a->row][c] += k * rows[a->column][c];
        }
        memcpy(rows, left, sizeof(left));
        for (const struct slope *a = slopes; a < slopes + slope_count; a++) {
            double k = a->per_s * h;
            for (int r = 0; r < at->size; r++)
                rows[r][a->row] += k * left[r][a->column];
        }
        for (int i = 0; i < at->disturbance; i++)
            rows[i][i] += walk;
        rows[at->disturbance][at->disturbance] += p->disturbance_w * p->disturbance_w * h;
        rows[at->gain][at->gain] += p->gain_walk * p->gain_walk * h;
        if (at->slant >= 0)
            rows[at->slant][at->slant] += SLANT_WALK_C * SLANT_WALK_C * h;
    }
}

// The offset of a stepped reading, as far as this sample shows it; returns what the reading is off by without it.
static double
stepped_off(struct run *run, const struct model_sample *sample, double sigma_c, double off_c)
{
    if (!sample->is_rebased)
        return off_c;
    run->rebased_c = REBASED_SIGMA * sigma_c;
    if (!(sample->output > run->driven && fabs(off_c) > OFFSET_C + OFFSET_SIGMA * sigma_c))
        return off_c;
    run->offset_c += off_c;
    run->offset_output = sample->output;
    return 0.0;
}

// Through the output of one sample; within it the expected temperature is a straight line.
static void
pass(const struct model_params *p, const struct model_state *s, struct run *run, const struct model_sample *sample,
     const struct model_line *flow, const struct model_line *fan)
{
    double before_c = run->nodes.sensor_c, span_s = greater(0.0, sample->end_s - run->time_s);
    struct model_drive drive = {sample->output, s->gain, s->disturbance_w};
    model_advance(p, &run->nodes, &drive, model_line_step(flow, run->time_s), model_line_step(fan, run->time_s), span_s);
    if (is_number(sample->temp_c)) {
        double sigma_c = sample->sigma_c > 0.0 ? sample->sigma_c : p->sigma_c, share = 1.0 / (sigma_c * sigma_c);
        if (run->offset_c && sample->output < OFFSET_SHARE * run->offset_output)
            run->offset_c = 0.0;
        double since = span_s ? lesser(1.0, greater(0.0, (sample->time_s - run->time_s) / span_s)) : 1.0;
        double expected_c = before_c + since * (run->nodes.sensor_c - before_c);
        double drive_share = sample->output / p->output_high;
        if (sample->is_rebased)
            run->usual = drive_share;
        double lever = drive_share - run->usual;
        expected_c += s->slant_c * lever;
        double off_c = stepped_off(run, sample, sigma_c, sample->temp_c - run->offset_c - expected_c);
        run->weight += share;
        run->levered += share * lever;
        run->pulled += share * off_c;
        run->measured_s = sample->time_s;
        run->driven = sample->output;
    }
    run->passed += sample->output * span_s;
    run->time_s += span_s;
}

static void
pass_group(const struct model_params *p, const struct model_state *s, struct run *run, const struct group *g,
           const struct model_line *flow, const struct model_line *fan)
{
    struct model_sample one = {g->end_s, g->end_s, NAN, 0.0, g->output, 0};
    if (g->weight) {
        one.time_s = g->moment / g->weight;
        one.temp_c = g->heat / g->weight;
        one.sigma_c = pow(g->weight, -0.5);
    } else if (!is_number(g->end_s)) {
        return;
    }
    pass(p, s, run, &one, flow, fan);
}

// Variance of one sample by coloured errors, which do not average out within its time.
static double
coloured_variance(const struct model_params *p, const struct model_state *s, const struct model_sample *sample, double last_s)
{
    double span_s = greater(2.0 * (sample->end_s - sample->time_s), lesser(sample->end_s - last_s, COLOURED_GAP_S));
    return p->coloured_c2_s && span_s > 0.0 ? (p->coloured_c2_s + SWING_S * s->swing_c * s->swing_c) / span_s : 0.0;
}

static struct run
walk_through(const struct model_params *p, const struct model_state *s, const struct model_sample *samples, int count,
             const struct model_line *flow, const struct model_line *fan)
{
    struct run run = {.nodes = s->nodes, .time_s = s->time_s, .measured_s = s->measured_s, .driven = s->driven,
                      .offset_c = s->offset_c, .offset_output = s->offset_output, .usual = s->usual};
    struct group g = {.end_s = NAN, .output = NAN};
    double last_s = s->measured_s;
    for (const struct model_sample *sample = samples; sample < samples + count; sample++) {
        if (sample->output != g.output || sample->is_rebased) {
            pass_group(p, s, &run, &g, flow, fan);
            g = (struct group){.end_s = NAN, .output = sample->output};
            if (sample->is_rebased) {
                pass(p, s, &run, sample, flow, fan);
                continue;
            }
        }
        g.end_s = sample->end_s;
        if (is_number(sample->temp_c)) {
            double sigma_c = sample->sigma_c ? sample->sigma_c : p->sigma_c;
            double share = 1.0 / (sigma_c * sigma_c + coloured_variance(p, s, sample, last_s));
            last_s = sample->end_s;
            run.own += 1.0 / (sigma_c * sigma_c);
            g.weight += share;
            g.heat += share * sample->temp_c;
            g.moment += share * sample->time_s;
        }
    }
    pass_group(p, s, &run, &g, flow, fan);
    double elapsed_s = run.time_s - s->time_s;
    run.output = elapsed_s > 0.0 ? run.passed / elapsed_s : s->output;
    run.innovation_c = run.weight ? run.pulled / run.weight : 0.0;
    run.lever = run.weight ? run.levered / run.weight : 0.0;
    return run;
}

// What the covariance of place `i` with the expected reading is: with the node measured, and with the slant by its lever.
static double
with_reading(const struct model_state *s, const struct model_places *at, const struct run *run, int i)
{
    double node = s->covariance[i][at->measured];
    return at->slant >= 0 ? node + run->lever * s->covariance[i][at->slant] : node;
}

// Variance of the innovation.
static double
innovation_variance(const struct model_state *s, const struct model_places *at, const struct run *run)
{
    double expected = with_reading(s, at, run, at->measured);
    if (at->slant >= 0)
        expected += run->lever * with_reading(s, at, run, at->slant);
    return expected + 1.0 / run->weight;
}

// Doubt more where the innovation says that the model was wrong.
static void
widen(const struct model_params *p, const struct model_places *at, struct model_state *s, const struct run *run)
{
    int m = at->measured, d = at->disturbance;
    double variance = innovation_variance(s, at, run);
    double jump_c = p->coloured_c2_s ? COLOURED_JUMP_C : JUMP_C;
    int jumped = fabs(run->innovation_c) > jump_c + JUMP_SIGMA * sqrt(variance);
    double loose_c = greater(run->rebased_c, jumped ? JUMPED_C : 0.0);
    if (loose_c) {
        double loose = s->covariance[m][m] + loose_c * loose_c;
        for (int i = 0; i < at->size; i++)
            s->covariance[m][i] = s->covariance[i][m] = 0.0;
        s->covariance[m][m] = loose;
        s->lean = 0.0;
        return;
    }
    if (p->coloured_c2_s)
        return;
    s->lean = LEAN_KEEP * s->lean + run->innovation_c / sqrt(variance);
    if (fabs(s->lean) > LEAN_MAX)
        s->covariance[d][d] += square(LEAN_SHARE * p->disturbance_start_w);
    else if (run->innovation_c * run->innovation_c / variance > SURPRISE)
        s->covariance[d][d] += SURPRISED_W * SURPRISED_W;
}

// The readings are in so much doubt that they show no swing, and no error of the model.
static int
is_doubtful(const struct run *run)
{
    return run->own * SWING_DOUBT_C * SWING_DOUBT_C < 1.0;
}

// With coloured errors, what surprises about readings in doubt is their error, not the temperature's.
static void
doubt_reading(const struct model_params *p, const struct model_places *at, struct model_state *s, struct run *run)
{
    double more = square(run->innovation_c) / SURPRISE - innovation_variance(s, at, run);
    if (p->coloured_c2_s && more > 0.0 && is_doubtful(run))
        run->weight = 1.0 / (1.0 / run->weight + more);
}

// Follow the half waves of the innovations.
static void
follow_swing(struct model_state *s, double by_c, double dt_s)
{
    double keep = exp(-dt_s / SWING_KEEP_S);
    s->swing_c *= keep;
    s->half_c *= keep;
    s->before_c *= keep;
    int other = by_c * s->half_c < 0.0;
    if (other && fabs(by_c) > SWING_SHARE * fabs(s->half_c)) {
        s->swing_c = greater(s->swing_c, lesser(fabs(s->half_c), s->before_c));
        s->before_c = fabs(s->half_c);
        s->half_c = by_c;
    } else if (!other && fabs(by_c) > fabs(s->half_c)) {
        s->half_c = by_c;
    }
}

// The nodes after an update; bore and an ideal sensor go with the controlled node.
static void
move(const struct model_params *p, const struct model_places *at, struct model_nodes *n, const double *gains, double by_c)
{
    double step_c = gains[at->temp] * by_c, before_c = n->temp_c;
    n->element_c += at->element >= 0 ? gains[at->element] * by_c : step_c;
    n->second_c += at->second >= 0 ? gains[at->second] * by_c : 0.0;
    n->temp_c += step_c;
    double hottest_c = greater(greater(n->temp_c, before_c), p->ambient_c) + SECOND_MARGIN_C;
    n->second_c = lesser(hottest_c, greater(p->ambient_c - SECOND_MARGIN_C, n->second_c));
    n->sensor_c += at->sensor >= 0 ? gains[at->sensor] * by_c : step_c;
    n->bore_c += step_c;
}

// So many places learn from this innovation; gain and slant are the last.
static int
learning(const struct model_params *p, const struct model_places *at, const struct model_state *s, const struct run *run)
{
    if (p->coloured_c2_s && run->output < GAIN_SHARE * p->output_high)
        return at->gain;
    int is_known = s->covariance[at->gain][at->gain] <= square(SLANT_GAIN * s->gain);
    return at->slant >= 0 && !is_known ? at->slant : at->size;
}

static void
update(const struct model_params *p, const struct model_places *at, struct model_state *s, const struct run *run)
{
    double by_c = run->innovation_c, read_c = s->nodes.sensor_c + by_c, column[MODEL_PLACES] = {0}, gains[MODEL_PLACES] = {0};
    double variance = innovation_variance(s, at, run);
    int learns = learning(p, at, s, run);
    for (int i = 0; i < at->size; i++) {
        column[i] = with_reading(s, at, run, i);
        gains[i] = column[i] / variance;
    }
    for (int i = 0; i < at->size; i++)
        for (int j = 0; j < at->size; j++)
            if (i < learns || j < learns)
                s->covariance[i][j] -= gains[i] * column[j];
    for (int i = learns; i < at->size; i++)
        gains[i] = 0.0;
    s->gain = lesser(GAIN_MAX, greater(GAIN_MIN, s->gain + gains[at->gain] * by_c));
    s->disturbance_w = bounded(s->disturbance_w + gains[at->disturbance] * by_c, p->disturbance_max_w);
    s->slant_c += at->slant >= 0 ? gains[at->slant] * by_c : 0.0;
    move(p, at, &s->nodes, gains, by_c);
    s->innovation_c = by_c;
    double since_s = run->time_s - s->read_to_s;
    s->read_to_s = run->time_s;
    s->read_s += since_s;
    s->read_cs += read_c * since_s;
    s->measured_s = run->measured_s;
    s->driven = run->driven;
    s->offset_c = run->offset_c;
    s->offset_output = run->offset_output;
}

// The usual drive follows the drive, and the temperature that would be read there with it.
static void
follow_usual(const struct model_params *p, const struct model_places *at, struct model_state *s, const struct run *run,
             double dt_s)
{
    if (at->slant < 0)
        return;
    double by = (run->output / p->output_high - run->usual) * dt_s / (SLANT_USUAL_S + dt_s), by_c = by * s->slant_c;
    s->usual = run->usual + by;
    s->nodes.temp_c += by_c;
    s->nodes.sensor_c += by_c;
    s->nodes.bore_c += by_c;
    int moved[2] = {at->temp, at->sensor}, count = 1 + (at->sensor >= 0);
    for (int n = 0; n < count; n++)
        for (int i = 0; i < at->size; i++)
            s->covariance[moved[n]][i] += by * s->covariance[at->slant][i];
    for (int n = 0; n < count; n++)
        for (int i = 0; i < at->size; i++)
            s->covariance[i][moved[n]] += by * s->covariance[i][at->slant];
}

// Begin at the newest temperature among these, if there is one.
static void
begin_anew(const struct model_params *p, struct model_state *s, const struct model_sample *samples, int count)
{
    for (const struct model_sample *newest = samples + count; newest-- > samples;) {
        if (is_number(newest->temp_c)) {
            model_begin(p, s, newest->temp_c, newest->end_s);
            s->usual = newest->output / p->output_high;
            return;
        }
    }
}

// The samples of one innovation.
static void
observe_piece(const struct model_params *p, const struct model_places *at, struct model_state *s,
              const struct model_sample *samples, int count, const struct model_line *flow,
              const struct model_line *fan)
{
    struct slope slopes[SLOPES_MAX];
    struct run run = walk_through(p, s, samples, count, flow, fan);
    int slope_count = find_slopes(p, at, &run, model_line_step(fan, run.time_s), slopes);
    spread(p, at, s->covariance, slopes, slope_count, run.time_s - s->time_s);
    double moved_c = fabs(run.nodes.temp_c - s->nodes.temp_c), dt_s = run.time_s - s->time_s;
    s->covariance[at->disturbance][at->disturbance] += p->disturbance_w2_per_k * moved_c;
    s->time_s = run.time_s;
    s->nodes = run.nodes;
    if (!run.weight)
        return;
    widen(p, at, s, &run);
    doubt_reading(p, at, s, &run);
    if (p->coloured_c2_s)
        follow_swing(s, is_doubtful(&run) ? 0.0 : run.innovation_c, dt_s);
    update(p, at, s, &run);
    follow_usual(p, at, s, &run, dt_s);
}

void
model_observe(const struct model_params *p, struct model_state *s, const struct model_sample *samples, int count,
              const struct model_line *flow, const struct model_line *fan)
{
    s->read_s = s->read_cs = 0.0;
    if (!count)
        return;
    struct model_places at = model_layout(p);
    int is_other = !s->size || s->nodes_known != at.nodes;
    if (!is_number(s->time_s) || is_other || samples[count - 1].end_s - s->measured_s > p->gap_s) {
        begin_anew(p, s, samples, count);
        return;
    }
    for (int first = 0; first < count; first += TOGETHER_MAX) {
        int piece = count - first < TOGETHER_MAX ? count - first : TOGETHER_MAX;
        observe_piece(p, &at, s, samples + first, piece, flow, fan);
    }
}
