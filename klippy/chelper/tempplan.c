/* The temperature plan; see tempplan.h, and the Python modules it names for the theory. */
#include "tempplan.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "tempplan_map.h"

static const double PIECE_C = 5.0;          /* as in thermal/plan.py */
static const double NEGLIGIBLE_C = 0.05;
static const double LEAST_RATE_K_S = 1e-6;

struct tempplan {
    struct tempplan_params p;
    double *loss_w, *capacity_j_k, *core_share;
    int degrees, cores;
    struct deposit_map map;
    struct pace_clock clock;
    double usual_c, usual_mm;               /* interface by the user's own temperature, averaged over so much path */
    struct tempplan_piece *pieces;          /* those of the future and of the part planned but not yet laid */
    double *starts, *melts_w_k, *walls_c;
    int count, room;
    struct tempplan_point *points;
    int point_count, point_room;
    double holder_c, holder_from_s;         /* nozzle temperature at which the holder would be in balance, and when */
    struct tempplan_report report;
};

/* -- nozzle -- */

static double melt_share(const struct tempplan_params *p, double flow_mm3_s)
{
    double capacity_w_k = 1e-3 * p->heat_mj_m3k * flow_mm3_s;
    return capacity_w_k <= 1e-9 ? 1.0 : -expm1(-p->ua_w_k / capacity_w_k);
}

static double melt_heat_w_k(const struct tempplan_params *p, double flow_mm3_s)
{
    return flow_mm3_s > 0.0 ? 1e-3 * p->heat_mj_m3k * flow_mm3_s * melt_share(p, flow_mm3_s) : 0.0;
}

static double lag_s(const struct tempplan_params *p, double flow_mm3_s)
{
    if (p->melt_mm3 <= 0.0)
        return p->bore_lag_s;
    double adapted_s = 1e-3 * p->heat_mj_m3k * p->melt_mm3 / p->ua_w_k;
    return p->bore_lag_s + fmin(adapted_s, p->melt_mm3 / fmax(flow_mm3_s, 1e-9));
}

/* Wall at which the filament's core reaches core_c (source 004), from the table over flow. */
static double core_wall_c(const struct tempplan *tp, double flow_mm3_s)
{
    const struct tempplan_params *p = &tp->p;
    double at = flow_mm3_s / p->core_step_mm3_s;
    int i = (int)fmin(at, tp->cores - 2.0);
    double share = tp->core_share[i] + fmin(1.0, at - i) * (tp->core_share[i + 1] - tp->core_share[i]);
    return p->inlet_c + (p->core_c - p->inlet_c) / fmax(share, 1e-6);
}

static double wall_for(const struct tempplan *tp, double melt_c, double flow_mm3_s)
{
    const struct tempplan_params *p = &tp->p;
    double wall_c = p->inlet_c + (melt_c - p->inlet_c) / fmax(melt_share(p, flow_mm3_s), 1e-6);
    if (!isnan(p->core_c))
        wall_c = fmax(wall_c, core_wall_c(tp, flow_mm3_s));
    return fmin(p->ceiling_c, fmax(p->floor_c, wall_c));
}

static double rate_k_s(const struct tempplan *tp, double start_c, double end_c, double melt_w_k, double holder_c)
{
    const struct tempplan_params *p = &tp->p;
    int floor_c = end_c > 0.0 ? (int)end_c : 0;
    if (floor_c > tp->degrees - 2)
        floor_c = tp->degrees - 2;
    double capacity_j_k = tp->capacity_j_k[floor_c + 1];
    double melt_w = melt_w_k * fmax(0.0, end_c - p->inlet_c), holder_w = p->holder_w_k * (end_c - holder_c);
    if (end_c > start_c)
        return fmax(LEAST_RATE_K_S, (p->power_w - holder_w - tp->loss_w[floor_c + 1] - melt_w) / capacity_j_k);
    return fmax(LEAST_RATE_K_S, (holder_w + tp->loss_w[floor_c] + melt_w) / capacity_j_k);
}

/* -- part -- */

static void note_age(struct tempplan_report *r, const struct column *c, const struct dab *below, const struct dab *dab)
{
    r->side_per_mm += dab->length_mm * c->side_per_mm;
    r->above_mm += dab->length_mm;
    r->age_s += dab->length_mm * (dab->time_s - below->time_s);
    r->laying_s += dab->length_mm * (dab->clock.laying_s - below->clock.laying_s);
    r->full_speed_s += dab->length_mm * (dab->clock.full_speed_s - below->clock.full_speed_s);
}

static int samples_of(const struct tempplan_params *p, const struct tempplan_piece *q, double *length_mm)
{
    double dx = q->end_pos[0] - q->start_pos[0], dy = q->end_pos[1] - q->start_pos[1];
    *length_mm = sqrt(dx * dx + dy * dy);
    double n = ceil(*length_mm / p->cell_mm);
    return n < 1.0 ? 1 : n > 10000.0 ? 10000 : (int)n;
}

static double wanted_melt_c(struct tempplan *tp, const struct tempplan_piece *q, double length_mm)
{
    const struct tempplan_params *p = &tp->p;
    double melt_c = q->wish_c;
    if (isnan(melt_c)) {
        melt_c = p->inlet_c + (q->base_c - p->inlet_c) * melt_share(p, q->flow_mm3_s);
        if (!isnan(p->interface_c))
            melt_c = 2.0 * tempplan_interface(tp) - q->substrate_c[0];     /* like media meet at the mean */
        tp->report.cold_mm += melt_c > p->high_c ? length_mm : 0.0;
        tp->report.hot_mm += melt_c < p->low_c ? length_mm : 0.0;
    }
    return fmin(p->high_c, fmax(p->low_c, melt_c));
}

static struct column *column_at(struct tempplan *tp, const struct tempplan_piece *q, double along)
{
    double x = q->start_pos[0] + along * (q->end_pos[0] - q->start_pos[0]);
    double y = q->start_pos[1] + along * (q->end_pos[1] - q->start_pos[1]);
    double cell_mm = tp->p.cell_mm;
    return map_column(&tp->map, (int32_t)floor(x / cell_mm), (int32_t)floor(y / cell_mm));
}

/* One piece with extrusion: what it meets, what it should be, and the map with it laid. */
static void settle(struct tempplan *tp, struct tempplan_piece *q)
{
    const struct tempplan_params *p = &tp->p;
    double length_mm;
    int n = samples_of(p, q, &length_mm);
    double speed_mm_s = length_mm / fmax(q->end_s - q->start_s, 1e-9);
    double width_mm = q->flow_mm3_s / fmax(speed_mm_s * q->height_mm, 1e-9);
    width_mm = fmin(5.0, fmax(0.1, width_mm));
    double fixed_c = p->inlet_c + (q->base_c - p->inlet_c) * melt_share(p, q->flow_mm3_s);
    double met[TEMPPLAN_HISTORIES] = { 0.0, 0.0 }, duration_s = q->end_s - q->start_s;
    for (int i = 0; i < n; i++) {
        double since_s = (i + 0.5) / n * duration_s;
        struct dab below, dab = {
            .time_s = q->start_s + since_s, .z_mm = q->end_pos[2], .thick_mm = q->height_mm, .width_mm = width_mm,
            .length_mm = length_mm / n, .fan = q->fan, .fixed_c = fixed_c,
            .clock = { tp->clock.laying_s + since_s, tp->clock.full_speed_s + since_s * q->pace },
        };
        struct column *c = column_at(tp, q, (i + 0.5) / n);
        tp->map.odometer_mm += dab.length_mm;
        if (column_lay(&tp->map, c, p, &dab, &below) && isnan(q->wish_c))
            note_age(&tp->report, c, &below, &dab);    /* what is asked for by name is no matter of pace */
        met[0] += c->met_c[0] / n;
        met[1] += c->met_c[1] / n;
    }
    memcpy(q->substrate_c, met, sizeof(met));
    tp->usual_mm = fmin(p->follow_mm, tp->usual_mm + length_mm);
    if (tp->usual_mm > 0.0)
        tp->usual_c += (0.5 * (fixed_c + met[1]) - tp->usual_c) * fmin(1.0, length_mm / tp->usual_mm);
    q->melt_c = wanted_melt_c(tp, q, length_mm);    /* by the whole piece; then it is in all its columns */
    for (int i = 0; i < n; i++)
        column_melt(column_at(tp, q, (i + 0.5) / n), q->melt_c);
    q->wall_c = wall_for(tp, q->melt_c, q->flow_mm3_s);
    tp->clock.laying_s += duration_s;
    tp->clock.full_speed_s += duration_s * q->pace;
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
    double *starts = realloc(tp->starts, room * sizeof(*starts));
    if (starts)
        tp->starts = starts;
    double *melts = realloc(tp->melts_w_k, room * sizeof(*melts));
    if (melts)
        tp->melts_w_k = melts;
    double *walls = realloc(tp->walls_c, room * sizeof(*walls));
    if (walls)
        tp->walls_c = walls;
    if (!pieces || !starts || !melts || !walls)
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
        if (q->flow_mm3_s > 0.0) {
            settle(tp, q);
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
    return 0;
}

/* -- plan: thermal/plan.py in the same order of sums -- */

static int same_wish(const struct tempplan_piece *a, const struct tempplan_piece *b)
{
    return a->wish_c == b->wish_c || (isnan(a->wish_c) && isnan(b->wish_c));
}

/* One stretch of path with the same wish: its walls averaged by volume over smooth_s to both sides of each piece. */
static void smooth_stretch(struct tempplan *tp, int first, int end, double half_s)
{
    double sum = 0.0, volume = 0.0;
    int low = first, high = first;
    for (int i = first; i < end; i++) {
        const struct tempplan_piece *q = &tp->pieces[i];
        for (; high < end && tp->pieces[high].start_s < q->end_s + half_s; high++) {
            double mm3 = tp->pieces[high].flow_mm3_s * (tp->pieces[high].end_s - tp->pieces[high].start_s);
            volume += mm3;
            sum += mm3 * tp->pieces[high].wall_c;
        }
        for (; low < high && tp->pieces[low].end_s <= q->start_s - half_s; low++) {
            double mm3 = tp->pieces[low].flow_mm3_s * (tp->pieces[low].end_s - tp->pieces[low].start_s);
            volume -= mm3;
            sum -= mm3 * tp->pieces[low].wall_c;
        }
        double wall_c = volume > 1e-6 ? sum / volume : q->wall_c;
        tp->walls_c[i] = fmin(tp->p.ceiling_c, fmax(tp->p.floor_c, wall_c));
    }
}

/* Walls as they are gone after. What is asked for by name stays a step: only within a wish is averaged. */
static void smooth_walls(struct tempplan *tp, int first)
{
    int smooth = tp->p.smooth_s > 0.0 && tp->p.preview != 0.0;
    for (int i = first, end; i < tp->count; i = end) {
        for (end = i + 1; smooth && end < tp->count && same_wish(&tp->pieces[i], &tp->pieces[end]); end++)
            ;
        if (smooth)
            smooth_stretch(tp, i, end, tp->p.smooth_s);
        else
            tp->walls_c[i] = tp->pieces[i].wall_c;
    }
}

static void find_starts(struct tempplan *tp, int first, double from_s, double start_c)
{
    double demand_s = 0.0, later_s = INFINITY;
    int direction = 0;
    for (int i = tp->count - 1; i >= first; i--) {
        const struct tempplan_piece *q = &tp->pieces[i];
        double before_c = i > first ? tp->walls_c[i - 1] : start_c;
        double step_c = tp->walls_c[i] - before_c;
        double at_s = q->start_s - lag_s(&tp->p, q->flow_mm3_s);
        demand_s = fmax(0.0, demand_s - (later_s - at_s));
        if (fabs(step_c) > NEGLIGIBLE_C) {
            int sign = step_c > 0.0 ? 1 : -1;
            double melt_w_k = i > first ? tp->melts_w_k[i - 1] : 0.0;
            double needed_s = fabs(step_c) / rate_k_s(tp, before_c, tp->walls_c[i], melt_w_k, tp->holder_c);
            demand_s = needed_s + (sign == direction ? demand_s : 0.0);
            direction = sign;
        }
        later_s = at_s;
        tp->starts[i] = tp->p.preview != 0.0 ? at_s - 0.5 * demand_s : q->start_s;
    }
    double latest_s = from_s;
    for (int i = first; i < tp->count; i++) {
        latest_s = fmax(latest_s, tp->starts[i]);
        tp->starts[i] = latest_s;
    }
}

static int add_point(struct tempplan *tp, double time_s, double temp_c)
{
    if (tp->point_count == tp->point_room) {
        int room = tp->point_room ? 2 * tp->point_room : 256;
        struct tempplan_point *points = realloc(tp->points, room * sizeof(*points));
        if (!points)
            return -1;
        tp->points = points;
        tp->point_room = room;
    }
    tp->points[tp->point_count++] = (struct tempplan_point){ time_s, temp_c };
    return 0;
}

static double holder_after(const struct tempplan *tp, double holder_c, double nozzle_c, double time_s)
{
    return holder_c - (nozzle_c - holder_c) * expm1(-time_s / tp->p.holder_s);
}

/* The holder at from_s, where the nozzle is at start_c: it has followed what was planned. */
static void bring_holder(struct tempplan *tp, double from_s, double start_c)
{
    if (!tp->point_count || from_s - tp->holder_from_s > 5.0 * tp->p.holder_s)
        tp->holder_c = start_c;
    else
        for (double step_s = 0.1, at_s = tp->holder_from_s; at_s < from_s; at_s += step_s) {
            step_s = fmin(step_s, from_s - at_s);
            tp->holder_c = holder_after(tp, tp->holder_c, tempplan_at(tp, at_s + 0.5 * step_s, start_c), step_s);
        }
    tp->holder_from_s = from_s;
}

/* Move towards the target until until_s, a corner wherever the slope changes. */
static int ramp(struct tempplan *tp, double now_s, double *now_c, double until_s, double target_c, double melt_w_k,
                double *holder_c)
{
    while (now_s < until_s && fabs(target_c - *now_c) > 1e-9) {
        double step_c = fmin(PIECE_C, fmax(-PIECE_C, target_c - *now_c));
        double rate = rate_k_s(tp, *now_c, *now_c + step_c, melt_w_k, *holder_c), before_s = now_s, before_c = *now_c;
        if (tp->points[tp->point_count - 1].time_s < now_s && add_point(tp, now_s, *now_c))
            return -1;
        double needed_s = fabs(step_c) / rate;
        if (now_s + needed_s > until_s) {
            *now_c += copysign(rate * (until_s - now_s), step_c);
            now_s = until_s;
        } else {
            now_s += needed_s;
            *now_c += step_c;
        }
        if (add_point(tp, now_s, *now_c))
            return -1;
        *holder_c = holder_after(tp, *holder_c, 0.5 * (before_c + *now_c), now_s - before_s);
    }
    *holder_c = holder_after(tp, *holder_c, *now_c, fmax(0.0, until_s - now_s));
    return 0;
}

static int follow(struct tempplan *tp, int first, double from_s, double start_c)
{
    double now_s = from_s, now_c = start_c, holder_c = tp->holder_c;
    double target_c = fmin(tp->p.ceiling_c, fmax(tp->p.floor_c, start_c));
    double end_s = tp->pieces[tp->count - 1].end_s;
    int flow = first, turn = first;
    if (add_point(tp, now_s, now_c))
        return -1;
    while (now_s < end_s) {
        while (turn < tp->count && tp->starts[turn] <= now_s)
            target_c = tp->walls_c[turn++];
        while (flow < tp->count - 1 && tp->pieces[flow].end_s <= now_s)
            flow++;
        const struct tempplan_piece *q = &tp->pieces[flow];
        int inside = q->start_s <= now_s;
        double border_s = inside ? q->end_s : q->start_s;
        if (turn < tp->count)
            border_s = fmin(border_s, tp->starts[turn]);
        border_s = fmin(border_s, end_s);
        if (ramp(tp, now_s, &now_c, border_s, target_c, inside ? tp->melts_w_k[flow] : 0.0, &holder_c))
            return -1;
        now_s = border_s;
    }
    return add_point(tp, end_s, now_c);
}

int tempplan_make(struct tempplan *tp, double from_s, double start_c)
{
    int first = 0;
    while (first < tp->count && tp->pieces[first].end_s <= from_s)
        first++;
    if (first == tp->count)
        return 0;
    for (int i = first; i < tp->count; i++)
        tp->melts_w_k[i] = melt_heat_w_k(&tp->p, tp->pieces[i].flow_mm3_s);
    smooth_walls(tp, first);
    bring_holder(tp, from_s, start_c);
    find_starts(tp, first, from_s, start_c);
    /* what was planned up to from_s stays: pieces not yet booked look back at it */
    while (tp->point_count && tp->points[tp->point_count - 1].time_s >= from_s)
        tp->point_count--;
    int kept = tp->point_count;
    if (follow(tp, first, from_s, start_c)) {
        tp->point_count = kept;
        return 0;
    }
    return tp->point_count;
}

/* Number of the first point later than time_s. */
static int point_after(const struct tempplan *tp, double time_s)
{
    int low = 0, high = tp->point_count;
    while (low < high) {
        int middle = (low + high) / 2;
        if (tp->points[middle].time_s <= time_s)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

/* A line from the newest corner given out may go on as long as it can pass all points since at within_c. */
int tempplan_corners(const struct tempplan *tp, double since_s, double within_c, struct tempplan_point *out)
{
    int i = point_after(tp, since_s), count = 0;
    i -= i > 0;
    if (i == tp->point_count)
        return 0;
    out[count++] = tp->points[i++];
    double low = -INFINITY, high = INFINITY;    /* slopes that it may have, K/s */
    for (; i < tp->point_count; i++) {
        const struct tempplan_point *a = &out[count - 1], *b = &tp->points[i];
        double past_s = b->time_s - a->time_s, slope = (b->temp_c - a->temp_c) / past_s;
        if (within_c > 0.0 && past_s > 0.0 && slope >= low && slope <= high) {
            low = fmax(low, slope - within_c / past_s);
            high = fmin(high, slope + within_c / past_s);
            continue;
        }
        if (a->time_s != tp->points[i - 1].time_s || a->temp_c != tp->points[i - 1].temp_c) {
            out[count++] = tp->points[--i];     /* and this one again from there */
        } else {
            out[count++] = *b;
        }
        low = -INFINITY;
        high = INFINITY;
    }
    if (out[count - 1].time_s != tp->points[tp->point_count - 1].time_s)
        out[count++] = tp->points[tp->point_count - 1];
    return count;
}

int tempplan_lead(struct tempplan *tp, const struct tempplan_point *points, int count)
{
    while (tp->point_count && tp->points[tp->point_count - 1].time_s >= points[0].time_s)
        tp->point_count--;
    for (int i = 0; i < count; i++)
        if (add_point(tp, points[i].time_s, points[i].temp_c))
            return -1;
    return 0;
}

double tempplan_holder(struct tempplan *tp, double time_s, double nozzle_c)
{
    bring_holder(tp, time_s, nozzle_c);
    return tp->holder_c;
}

double tempplan_at(const struct tempplan *tp, double time_s, double otherwise_c)
{
    if (!tp->point_count)
        return otherwise_c;
    int low = point_after(tp, time_s);
    if (!low)
        return tp->points[0].temp_c;
    if (low == tp->point_count)
        return tp->points[low - 1].temp_c;
    const struct tempplan_point *a = &tp->points[low - 1], *b = &tp->points[low];
    return a->temp_c + (b->temp_c - a->temp_c) * (time_s - a->time_s) / (b->time_s - a->time_s);
}

/* -- books -- */

static void book(struct tempplan *tp, const struct tempplan_piece *q, double row[9])
{
    const struct tempplan_params *p = &tp->p;
    struct tempplan_report *r = &tp->report;
    double length_mm;
    samples_of(p, q, &length_mm);
    double middle_s = 0.5 * (q->start_s + q->end_s);
    double wall_c = tempplan_at(tp, middle_s - lag_s(p, q->flow_mm3_s), q->wall_c);
    double share = melt_share(p, q->flow_mm3_s);
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
            book(tp, &tp->pieces[over], wanted ? done + 9 * rows : unused);
            rows += wanted;
        }
        over++;
    }
    if (over) {
        tp->count -= over;
        memmove(tp->pieces, tp->pieces + over, tp->count * sizeof(*tp->pieces));
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

void tempplan_shift(struct tempplan *tp, double from_s, double delta_c)
{
    if (tp->usual_mm > 0.0)
        tp->usual_c += 0.5 * delta_c;
    for (int i = tp->count - 1; i >= 0 && tp->pieces[i].start_s >= from_s; i--) {
        struct tempplan_piece *q = &tp->pieces[i];
        q->base_c += delta_c;
        if (!isnan(q->wish_c))
            continue;
        if (isnan(q->melt_c)) {             /* a travel */
            q->wall_c = fmin(tp->p.ceiling_c, fmax(tp->p.floor_c, q->wall_c + delta_c));
        } else {
            q->melt_c = fmin(tp->p.high_c, fmax(tp->p.low_c, q->melt_c + delta_c));
            q->wall_c = wall_for(tp, q->melt_c, q->flow_mm3_s);
        }
    }
}

double tempplan_interface(const struct tempplan *tp)
{
    double least_c = tp->p.interface_c;     /* fmax would drop the NaN */
    return tp->p.follow_mm > 0.0 && tp->usual_c > least_c ? tp->usual_c : least_c;
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
    tp->p = *params;
    tp->holder_from_s = -INFINITY;
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
    free(tp->starts);
    free(tp->melts_w_k);
    free(tp->walls_c);
    free(tp->points);
    free(tp);
}
