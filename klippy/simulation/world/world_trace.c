/* What is written down while time passes: CSV rows and the heater's figures, at one fixed rate.
 *
 * Row n holds the state at n * period; the heater traced is the first nozzle, or without one the first load that is not a bed.
 * Host-side values (targets, estimate) are those of the last world_set_channel().
 */
#include "world_internal.h"

#include <errno.h>
#include <string.h>

static const double BAND_C = 3.0;           /* "settled": the accuracy promised for printing */
static const double SETTLE_S = 2.0;         /* time in band without a break */
static const double OVERSHOOT_SPAN_S = 15.0;
static const double TARGET_CHANGE_C = 0.05; /* smaller moves of the target are no new task */
static const double TARGET_OFF_C = 1.0;
static const double CLIMB_C = 5.0;          /* a target that much above the nozzle is a climb */
static const double CLIMB_MAX_S = 120.0;    /* a nozzle that cannot reach its target */

/* What one row holds about the heater and the machine, apart from axes. */
struct observation {
    double true_c, bore_c, mean_c, tip_c, melt_c, power_w, flow_mm3_s;
    double bed_c, fan;
    unsigned phase;
};

int world_trace_open(struct world *w, const char *path, double rate_hz)
{
    struct world_trace *t = &w->trace;
    if (!(rate_hz > 0.0 && rate_hz <= 1.0 / WORLD_TICK_S))
        return world_fail(w, "trace rate %g: from above 0 to %g rows a second", rate_hz, 1.0 / WORLD_TICK_S);
    *t = (struct world_trace){ .period_s = 1.0 / rate_hz, .next_s = w->start_s, .band_since_s = -1.0, .shown_since_s = -1.0 };
    if (!path)
        return 0;
    t->file = fopen(path, "w");
    if (!t->file)
        return world_fail(w, "cannot write the trace %s: %s", path, strerror(errno));
    setvbuf(t->file, NULL, _IOFBF, 1 << 16);
    fputs("t_s,target_c,estimate_c,true_c,bore_c,melt_c,phase_ticks,power_w,flow_mm3_s,"
          "x_mm,y_mm,z_mm,e_mm,bed_c,bed_target_c,fan,mean_c,tip_c,melt_target_c,warning,"
          "sigma_c,drift_c,supply\n", t->file);
    return 0;
}

int world_trace_close(struct world *w)
{
    FILE *file = w->trace.file;
    w->trace.file = NULL;
    if (!file)
        return 0;
    int failed = ferror(file);
    if (fclose(file) || failed)
        return world_fail(w, "the trace could not be written to its end: is the disc full?");
    return 0;
}

static void observe(const struct world *w, struct observation *o)
{
    const struct machine *m = &w->machine;
    *o = (struct observation){ .true_c = NAN, .bore_c = NAN, .mean_c = NAN, .tip_c = NAN, .melt_c = NAN, .bed_c = NAN };
    for (int i = 0; i < m->load_count; i++) {
        struct thermal_load_outputs out;
        thermal_load_read(&m->loads[i].thermal, &out);
        if (m->loads[i].is_bed) {
            o->bed_c = out.body_c;
        } else if (!m->nozzle_count && isnan(o->true_c)) {
            o->true_c = o->bore_c = o->mean_c = o->tip_c = out.body_c;
            o->melt_c = out.melt_c;
            o->power_w = out.power_w;
            o->flow_mm3_s = out.flow_mm3_s;
        }
    }
    if (m->nozzle_count) {
        struct plant_outputs out;
        plant_read(&m->nozzles[0].plant, &out);
        o->true_c = out.skin_c;
        o->bore_c = out.bore_c;
        o->mean_c = out.mean_c;
        o->tip_c = out.tip_c;
        o->melt_c = out.melt_c;
        o->power_w = out.power_w;
        o->flow_mm3_s = out.flow_mm3_s;
        o->phase = m->nozzles[0].phase;
    }
    if (m->fan_count)
        o->fan = m->fans[0].speed;
}

/* Time of the first nozzle to the band at full phase, from its state of now: no control can be faster. */
static double climb_bound_s(const struct world *w, double target_c)
{
    if (!w->machine.nozzle_count)
        return 0.0;
    struct plant copy = w->machine.nozzles[0].plant;
    double elapsed_s = 0.0;
    plant_set_phase(&copy, INFINITY);
    for (; copy.skin_c < target_c - BAND_C && elapsed_s < CLIMB_MAX_S; elapsed_s += WORLD_TICK_S)
        plant_advance(&copy, WORLD_TICK_S);
    return elapsed_s;
}

static struct world_target_epoch *begin_epoch(struct world_trace *t, double t_s, double from_c, double target_c)
{
    if (t->epoch_count < WORLD_EPOCHS)
        t->epoch_count++;
    struct world_target_epoch *e = &t->epochs[t->epoch_count - 1];
    *e = (struct world_target_epoch){
        .start_s = t_s, .from_c = from_c, .target_c = target_c, .reach_s = -1.0, .settle_s = -1.0,
        .shown_settle_s = -1.0,
    };
    t->band_since_s = t->shown_since_s = -1.0;
    t->last_target_c = target_c;
    return e;
}

static void follow_band(double *since_s, double t_s, int in_band)
{
    if (!in_band)
        *since_s = -1.0;
    else if (*since_s < 0.0)
        *since_s = t_s;
}

static void epoch_row(struct world *w, double t_s, double true_c)
{
    struct world_trace *t = &w->trace;
    const double target_c = w->channels[WORLD_TARGET_C], estimate_c = w->channels[WORLD_ESTIMATE_C];
    if (target_c < TARGET_OFF_C) {
        t->last_target_c = 0.0;
        return;
    }
    struct world_target_epoch *e = t->epoch_count ? &t->epochs[t->epoch_count - 1] : NULL;
    if (!e || fabs(target_c - t->last_target_c) > TARGET_CHANGE_C) {
        e = begin_epoch(t, t_s, true_c, target_c);
        if (target_c > true_c + CLIMB_C)
            e->bound_s = climb_bound_s(w, target_c);
    }
    double error_c = true_c - target_c, age_s = t_s - e->start_s;
    int in_band = fabs(error_c) <= BAND_C;
    follow_band(&t->band_since_s, t_s, in_band);
    follow_band(&t->shown_since_s, t_s, fabs(estimate_c - target_c) <= BAND_C);
    if (e->shown_settle_s < 0.0 && t->shown_since_s >= 0.0 && t_s - t->shown_since_s >= SETTLE_S)
        e->shown_settle_s = age_s;
    double beyond_c = e->from_c < target_c ? error_c : -error_c;
    if (e->reach_s < 0.0 && (in_band || beyond_c > 0.0))
        e->reach_s = age_s;
    if (e->reach_s >= 0.0 && age_s < e->reach_s + OVERSHOOT_SPAN_S)
        e->overshoot_c = fmax(e->overshoot_c, beyond_c);
    if (e->settle_s < 0.0) {
        if (in_band && t_s - t->band_since_s >= SETTLE_S)
            e->settle_s = age_s;
        return;
    }
    e->settled_seconds += t->period_s;
    e->max_error_c = fmax(e->max_error_c, fabs(error_c));
    e->error_sum += error_c * t->period_s;
    e->square_error_sum += error_c * error_c * t->period_s;
    if (!isnan(estimate_c))
        e->estimate_max_error_c = fmax(e->estimate_max_error_c, fabs(estimate_c - true_c));
}

static double role_position_mm(const struct world *w, int role)
{
    for (int i = 0; i < w->machine.axis_count; i++)
        if (w->machine.axes[i].options.role == role)
            return axis_position_mm(&w->machine.axes[i]);
    return 0.0;
}

static void write_row(const struct world *w, double t_s, const struct observation *o)
{
    const double *c = w->channels;
    fprintf(w->trace.file, "%.3f,%.2f,%.3f,%.3f,%.3f,%.3f,%u,%.3f,%.3f,%.4f,%.4f,%.4f,%.4f,%.2f,%.1f,%.3f,%.3f,%.3f,", t_s,
            c[WORLD_TARGET_C], c[WORLD_ESTIMATE_C], o->true_c, o->bore_c, o->melt_c, o->phase, o->power_w,
            o->flow_mm3_s, role_position_mm(w, WORLD_AXIS_X), role_position_mm(w, WORLD_AXIS_Y),
            role_position_mm(w, WORLD_AXIS_Z), role_position_mm(w, WORLD_AXIS_E), o->bed_c, c[WORLD_BED_TARGET_C],
            o->fan, o->mean_c, o->tip_c);
    fprintf(w->trace.file, "%.2f,%.0f,%.3f,%.3f,%.4f\n", c[WORLD_MELT_TARGET_C], c[WORLD_WARNING], c[WORLD_SIGMA_C],
            c[WORLD_DRIFT_C], c[WORLD_SUPPLY]);
}

void world_trace_row(struct world *w)
{
    struct world_trace *t = &w->trace;
    struct observation o;
    double t_s = (double)t->row * t->period_s;
    observe(w, &o);
    t->row++;
    t->next_s = w->start_s + (double)t->row * t->period_s - 0.5 * WORLD_TICK_S; /* the tick nearest to it */
    struct world_figures *f = &t->figures;
    f->rows = t->row;
    f->peak_c = fmax(f->peak_c, o.true_c);
    f->peak_power_w = fmax(f->peak_power_w, o.power_w);
    f->peak_flow_mm3_s = fmax(f->peak_flow_mm3_s, o.flow_mm3_s);
    f->energy_j += o.power_w * t->period_s;
    epoch_row(w, t_s, o.true_c);
    if (t->file)
        write_row(w, t_s, &o);
}

void world_figures(const struct world *w, struct world_figures *out)
{
    const struct machine *m = &w->machine;
    *out = w->trace.figures;
    if (m->nozzle_count)
        out->extruded_mm3 = m->nozzles[0].feed.volume_mm3;
    for (int i = 0; !m->nozzle_count && i < m->load_count; i++)
        out->extruded_mm3 += m->loads[i].feed.volume_mm3;
}

int world_epoch(const struct world *w, int index, struct world_target_epoch *out)
{
    if (index < 0 || index >= w->trace.epoch_count)
        return 0;
    *out = w->trace.epochs[index];
    return 1;
}
