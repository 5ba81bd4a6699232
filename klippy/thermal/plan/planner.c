/* The temperature plan; see planner.h, and the Python modules it names for the theory. */
#include "planner.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "planner_internal.h"

static const double LEFT_OF_A_LAYER = 0.1;  /* of a road's excess over the chamber is left when the next layer comes */
static const double GUESS_MM = 20000.0;     /* weight of that guess, as a length of path */

enum { FEW = 16 };                          /* columns of a piece that are not looked up twice */

/* -- part -- */

static void note_age(struct tempplan_report *r, const struct column *c, const struct dab *below, const struct dab *dab)
{
    r->side_per_mm += dab->length_mm * c->side_per_mm;
    r->above_mm += dab->length_mm;
    r->age_s += dab->length_mm * (dab->time_s - below->time_s);
    r->depositing_s += dab->length_mm * (dab->clock.depositing_s - below->clock.depositing_s);
    r->full_speed_s += dab->length_mm * (dab->clock.full_speed_s - below->clock.full_speed_s);
}

static int samples_of(const struct tempplan_params *p, const struct tempplan_piece *q, double *length_mm)
{
    double dx = q->end_pos[0] - q->start_pos[0], dy = q->end_pos[1] - q->start_pos[1];
    *length_mm = sqrt(dx * dx + dy * dy);
    double n = ceil(*length_mm / p->cell_mm);
    return n < 1.0 ? 1 : n > 10000.0 ? 10000 : (int)n;
}

static double wanted_melt_c(struct tempplan *tp, const struct tempplan_piece *q, double fixed_c, double length_mm)
{
    const struct tempplan_params *p = &tp->p;
    double melt_c = q->request_c;
    if (isnan(melt_c)) {
        melt_c = fixed_c;
        if (!isnan(p->interface_c))
            melt_c = 2.0 * tempplan_interface(tp) - q->substrate_c[0];     /* like media meet at the mean */
        tp->report.cold_mm += melt_c > p->high_c ? length_mm : 0.0;
        tp->report.hot_mm += melt_c < p->low_c ? length_mm : 0.0;
    }
    return lesser(p->high_c, greater(p->low_c, melt_c));
}

/* floor(), which is a call without SSE 4.1. */
static int32_t cell_of(double at)
{
    int32_t cell = (int32_t)at;
    return cell - (at < cell);
}

static struct column *column_at(struct tempplan *tp, const struct tempplan_piece *q, double along)
{
    double x = q->start_pos[0] + along * (q->end_pos[0] - q->start_pos[0]);
    double y = q->start_pos[1] + along * (q->end_pos[1] - q->start_pos[1]);
    double cell_mm = tp->p.cell_mm;
    return map_column(&tp->map, cell_of(x / cell_mm), cell_of(y / cell_mm));
}

/* The interface is wanted from both sides: the plan targets beyond the window, which then bounds what it does. */
static double wanted_c(const struct tempplan *tp, const struct tempplan_piece *q, double share)
{
    if (!isnan(q->request_c) || isnan(tp->p.interface_c))
        return q->wall_c;
    return tempplan_free_wall_c(tp, 2.0 * tempplan_interface(tp) - q->substrate_c[0], q->flow_mm3_s, share);
}

/* Interface by the user's own temperature, on average over the path. What lies near the bed is not what comes later:
 * it hardly counts, and the average begins with a guess. */
static void note_usual(struct tempplan *tp, double fixed_c, double substrate_c, double z_mm, double length_mm)
{
    const struct tempplan_params *p = &tp->p;
    if (p->follow_mm <= 0.0)
        return;
    if (tp->usual_mm <= 0.0) {
        tp->usual_c = 0.5 * (fixed_c + p->chamber_c + LEFT_OF_A_LAYER * (fixed_c - p->chamber_c));
        tp->usual_mm = fmin(p->follow_mm, GUESS_MM);
    }
    if (z_mm != tp->weighed_z_mm) {
        tp->weighed_z_mm = z_mm;
        tp->z_weight = -expm1(-fmax(0.0, z_mm) / p->bed_reach_mm);
    }
    length_mm *= tp->z_weight;
    tp->usual_mm = fmin(p->follow_mm, tp->usual_mm + length_mm);
    tp->usual_c += (0.5 * (fixed_c + substrate_c) - tp->usual_c) * fmin(1.0, length_mm / tp->usual_mm);
}

/* What the window can make of the hottest and the coldest 5 % of all path so far. */
static void find_band(struct tempplan *tp)
{
    const double *mm = tp->report.substrate_mm, tail_mm = 0.05 * tp->report.added_mm;
    int cold = tp->min_bin, hot = tp->max_bin;
    for (double passed_mm = mm[cold]; passed_mm <= tail_mm && cold < TEMPPLAN_BINS - 1; passed_mm += mm[cold])
        cold++;
    for (double passed_mm = mm[hot]; passed_mm <= tail_mm && hot > 0; passed_mm += mm[hot])
        hot--;
    tp->report.lowest_c = 0.5 * (tp->p.low_c + hot);
    tp->report.highest_c = 0.5 * (tp->p.high_c + cold);
}

static void note_substrate(struct tempplan *tp, double substrate_c, double length_mm)
{
    int bin = (int)fmin(TEMPPLAN_BINS - 1.0, fmax(0.0, substrate_c));
    tp->report.added_mm += length_mm;
    tp->report.substrate_mm[bin] += length_mm;
    tp->min_bin = bin < tp->min_bin ? bin : tp->min_bin;
    tp->max_bin = bin > tp->max_bin ? bin : tp->max_bin;
}

/* One piece with extrusion: what it meets, what it should be, and the map with it deposited. */
static void settle(struct tempplan *tp, struct tempplan_piece *q, double share)
{
    const struct tempplan_params *p = &tp->p;
    double length_mm;
    int n = samples_of(p, q, &length_mm);
    double speed_mm_s = length_mm / greater(q->end_s - q->start_s, 1e-9);
    double width_mm = q->flow_mm3_s / greater(speed_mm_s * q->height_mm, 1e-9);
    width_mm = lesser(5.0, greater(0.1, width_mm));
    double fixed_c = p->inlet_c + (q->base_c - p->inlet_c) * share;
    struct column *columns[FEW];
    double met[TEMPPLAN_HISTORIES] = { 0.0, 0.0 }, duration_s = q->end_s - q->start_s;
    for (int i = 0; i < n; i++) {
        double since_s = (i + 0.5) / n * duration_s;
        struct dab below, dab = {
            .time_s = q->start_s + since_s, .z_mm = q->end_pos[2], .thick_mm = q->height_mm, .width_mm = width_mm,
            .length_mm = length_mm / n, .fan = q->fan, .fixed_c = fixed_c,
            .clock = { tp->clock.depositing_s + since_s, tp->clock.full_speed_s + since_s * q->speed_factor },
        };
        struct column *c = column_at(tp, q, (i + 0.5) / n);
        if (i < FEW)
            columns[i] = c;
        tp->map.odometer_mm += dab.length_mm;
        if (column_deposit(&tp->map, c, p, &dab, &below) && isnan(q->request_c))
            note_age(&tp->report, c, &below, &dab);    /* a temperature asked for by name has no layer speed */
        met[0] += c->met_c[0] / n;
        met[1] += c->met_c[1] / n;
    }
    memcpy(q->substrate_c, met, sizeof(met));
    note_substrate(tp, met[0], length_mm);
    note_usual(tp, fixed_c, met[1], q->end_pos[2], length_mm);
    q->melt_c = wanted_melt_c(tp, q, fixed_c, length_mm);   /* by the whole piece; then it is in all its columns */
    for (int i = 0; i < n; i++)
        column_melt(i < FEW ? columns[i] : column_at(tp, q, (i + 0.5) / n), q->melt_c);
    q->wall_c = tempplan_wall_for(tp, q->melt_c, q->flow_mm3_s, share);
    q->wanted_c = wanted_c(tp, q, share);
    tp->clock.depositing_s += duration_s;
    tp->clock.full_speed_s += duration_s * q->speed_factor;
    tp->report.slowed_s += duration_s * (1.0 - q->speed_factor);
}

static int reserve(struct tempplan *tp, int more)
{
    if (tp->count + more <= tp->room)
        return 0;
    int room = tp->room ? tp->room : 256;
    while (room < tp->count + more)
        room *= 2;
    struct tempplan_piece *pieces = realloc(tp->pieces, room * sizeof(*pieces));
    if (pieces)
        tp->pieces = pieces;
    double *shares = realloc(tp->shares, room * sizeof(*shares));
    if (shares)
        tp->shares = shares;
    if (!pieces || !shares)
        return -1;
    tp->room = room;
    return 0;
}

int tempplan_add(struct tempplan *tp, struct tempplan_piece *pieces, int count)
{
    uint64_t columns = 0;
    for (int i = 0; i < count; i++) {
        double length_mm;
        columns += pieces[i].flow_mm3_s > 0.0 ? (uint64_t)samples_of(&tp->p, &pieces[i], &length_mm) : 0;
    }
    if (reserve(tp, count) || map_reserve(&tp->map, columns))
        return -1;
    for (int i = 0; i < count; i++) {
        struct tempplan_piece *q = &pieces[i];
        double share = tp->shares[tp->count] = tempplan_melt_share(&tp->p, q->flow_mm3_s);
        if (q->flow_mm3_s > 0.0) {
            settle(tp, q, share);
        } else {                            /* a travel wants what the piece before it wanted */
            double length_mm;
            samples_of(&tp->p, q, &length_mm);
            tp->map.odometer_mm += length_mm;
            q->substrate_c[0] = q->substrate_c[1] = q->melt_c = NAN;
            double before_c = tp->count ? tp->pieces[tp->count - 1].wall_c : q->base_c;
            q->wall_c = fmin(tp->p.ceiling_c, fmax(tp->p.floor_c, before_c));
        }
        tp->pieces[tp->count++] = *q;
    }
    find_band(tp);
    return 0;
}

/* -- totals -- */

static void record(struct tempplan *tp, const struct tempplan_piece *q, double share, double row[9])
{
    const struct tempplan_params *p = &tp->p;
    struct tempplan_report *r = &tp->report;
    double length_mm;
    samples_of(p, q, &length_mm);
    double middle_s = 0.5 * (q->start_s + q->end_s);
    double wall_c = tempplan_at(tp, middle_s - tempplan_lag_s(p, q->flow_mm3_s), q->wall_c);
    double melt_c[TEMPPLAN_HISTORIES] = {
        p->inlet_c + (wall_c - p->inlet_c) * share, p->inlet_c + (q->base_c - p->inlet_c) * share
    };
    r->length_mm += length_mm;
    r->pieces++;
    for (int k = 0; k < TEMPPLAN_HISTORIES; k++) {
        double interface_c = 0.5 * (melt_c[k] + q->substrate_c[k]);
        r->bonded_mm[k] += interface_c >= p->bonding_c ? length_mm : 0.0;
        int bin = (int)fmin(TEMPPLAN_BINS - 1.0, fmax(0.0, interface_c));
        r->interface_mm[k][bin] += length_mm;
        row[5 + 2 * k] = q->substrate_c[k];
        row[6 + 2 * k] = interface_c;
    }
    double off_c = melt_c[0] - q->melt_c;
    r->off_sum += off_c * length_mm;
    r->off_squares += off_c * off_c * length_mm;
    row[0] = q->start_s;
    row[1] = q->end_s;
    row[2] = wall_c;
    row[3] = q->melt_c;
    row[4] = melt_c[0];
}

int tempplan_finish(struct tempplan *tp, double until_s, double *done, int capacity)
{
    int over = 0, rows = 0;
    double unused[9] = { 0.0 };
    while (over < tp->count && tp->pieces[over].end_s <= until_s) {
        if (tp->pieces[over].flow_mm3_s > 0.0) {
            int wanted = done && rows < capacity;
            record(tp, &tp->pieces[over], tp->shares[over], wanted ? done + 9 * rows : unused);
            rows += wanted;
        }
        over++;
    }
    if (over) {
        tp->count -= over;
        memmove(tp->pieces, tp->pieces + over, tp->count * sizeof(*tp->pieces));
        memmove(tp->shares, tp->shares + over, tp->count * sizeof(*tp->shares));
    }
    /* two seconds of the past remain: bore and melt lag look back */
    int stale = 0;
    while (stale + 1 < tp->point_count && tp->points[stale + 1].time_s < until_s - 2.0)
        stale++;
    if (stale) {
        tp->point_count -= stale;
        memmove(tp->points, tp->points + stale, tp->point_count * sizeof(*tp->points));
    }
    return rows;
}

double tempplan_melt_at(const struct tempplan *tp, double time_s)
{
    int i = 0;
    while (i < tp->count && tp->pieces[i].end_s <= time_s)
        i++;
    return i < tp->count && tp->pieces[i].start_s <= time_s ? tp->pieces[i].melt_c : NAN;
}

void tempplan_shift(struct tempplan *tp, double from_s, double delta_c)
{
    if (tp->usual_mm > 0.0)
        tp->usual_c += 0.5 * delta_c;
    for (int i = tp->count - 1; i >= 0 && tp->pieces[i].start_s >= from_s; i--) {
        struct tempplan_piece *q = &tp->pieces[i];
        q->base_c += delta_c;
        if (!isnan(q->request_c))
            continue;
        if (isnan(q->melt_c)) {             /* a travel */
            q->wall_c = fmin(tp->p.ceiling_c, fmax(tp->p.floor_c, q->wall_c + delta_c));
        } else {
            q->melt_c = fmin(tp->p.high_c, fmax(tp->p.low_c, q->melt_c + delta_c));
            q->wall_c = tempplan_wall_for(tp, q->melt_c, q->flow_mm3_s, tp->shares[i]);
            q->wanted_c = wanted_c(tp, q, tp->shares[i]);
        }
    }
}

double tempplan_interface(const struct tempplan *tp)
{
    double lowest_c = tp->p.interface_c;     /* fmax would drop the NaN */
    if (isnan(lowest_c) || tp->usual_mm <= 0.0)
        return lowest_c;
    double usual_c = greater(tp->usual_c, lowest_c), added_mm = tp->report.added_mm;
    double kept_c = lesser(tp->report.highest_c, greater(tp->report.lowest_c, usual_c));
    if (tp->report.lowest_c > tp->report.highest_c)           /* the window is too narrow for both ends: the middle */
        kept_c = 0.5 * (tp->report.lowest_c + tp->report.highest_c);
    return greater(lowest_c, usual_c + (kept_c - usual_c) * added_mm / (added_mm + GUESS_MM));
}

double tempplan_speed_interface(const struct tempplan *tp)
{
    double held_c = tempplan_interface(tp);
    if (isnan(held_c) || tp->usual_mm <= 0.0)
        return held_c;
    return held_c + (1.0 - tp->z_weight) * greater(0.0, tp->report.highest_c - held_c);
}

void tempplan_cut(struct tempplan *tp, double time_s)
{
    while (tp->count && tp->pieces[tp->count - 1].start_s >= time_s)
        tp->count--;
    while (tp->point_count && tp->points[tp->point_count - 1].time_s > time_s)
        tp->point_count--;
}

const struct tempplan_report *tempplan_report(const struct tempplan *tp)
{
    return &tp->report;
}

void tempplan_sizes(const struct tempplan *tp, uint64_t sizes[2])
{
    sizes[0] = tp->map.used;
    sizes[1] = (uint64_t)tp->count;
}

/* -- life -- */

static double *copy_of(const double *values, int count)
{
    double *copy = malloc(count * sizeof(*copy));
    if (copy)
        memcpy(copy, values, count * sizeof(*copy));
    return copy;
}

struct tempplan *tempplan_alloc(const struct tempplan_params *params, const double *loss_w, const double *capacity_j_k,
                                int degrees, const double *core_share, int cores)
{
    struct tempplan *tp = calloc(1, sizeof(*tp));
    if (!tp)
        return NULL;
    tempplan_set(tp, params);
    tp->holder_from_s = -INFINITY;
    tp->min_bin = TEMPPLAN_BINS - 1;
    tp->loss_w = copy_of(loss_w, degrees);
    tp->capacity_j_k = copy_of(capacity_j_k, degrees);
    tp->core_share = copy_of(core_share, cores);
    tp->degrees = degrees;
    tp->cores = cores;
    if (!tp->loss_w || !tp->capacity_j_k || !tp->core_share || map_init(&tp->map)) {
        tempplan_free(tp);
        return NULL;
    }
    return tp;
}

void tempplan_set(struct tempplan *tp, const struct tempplan_params *params)
{
    tp->p = *params;
    tp->weighed_z_mm = tp->map.air_z_mm = NAN;
}

void tempplan_free(struct tempplan *tp)
{
    if (!tp)
        return;
    map_free(&tp->map);
    free(tp->loss_w);
    free(tp->capacity_j_k);
    free(tp->core_share);
    free(tp->pieces);
    free(tp->shares);
    best_free(&tp->path);
    free(tp->points);
    free(tp->corners);
    free(tp);
}
