/* From what is wanted of the nozzle to corners that it can go; the theory is in thermal/plan/set_points.py. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "planner_internal.h"

static const double PIECE_C = 5.0;          /* as in thermal/plan/set_points.py */
static const double NODE_S = 0.05;          /* as finely as the nozzle and its controller can follow */
static const int MAX_NODES = 8192;
static const double SAME_SLOPE_K_S = 1e-6;
static const double MIN_RATE_K_S = 1e-6;
static const double KEPT_S = 0.5;           /* a controller looks back at what it was asked for by less than that */

/* -- nozzle -- */

double tempplan_melt_share(const struct tempplan_params *p, double flow_mm3_s)
{
    double capacity_w_k = 1e-3 * p->heat_mj_m3k * flow_mm3_s;
    return capacity_w_k <= 1e-9 ? 1.0 : -expm1(-p->ua_w_k / capacity_w_k);
}

static double melt_heat_w_k(const struct tempplan *tp, const struct tempplan_piece *q)
{
    return q->flow_mm3_s > 0.0 ? 1e-3 * tp->p.heat_mj_m3k * q->flow_mm3_s * tp->shares[q - tp->pieces] : 0.0;
}

double tempplan_lag_s(const struct tempplan_params *p, double flow_mm3_s)
{
    if (p->melt_mm3 <= 0.0)
        return p->bore_lag_s;
    double adapted_s = 1e-3 * p->heat_mj_m3k * p->melt_mm3 / p->ua_w_k;
    return p->bore_lag_s + fmin(adapted_s, p->melt_mm3 / fmax(flow_mm3_s, 1e-9));
}

/* Wall at which the filament's core reaches core_c (Horoshailo 2019), from the table over flow. */
static double core_wall_c(const struct tempplan *tp, double flow_mm3_s)
{
    const struct tempplan_params *p = &tp->p;
    double at = flow_mm3_s / p->core_step_mm3_s;
    int i = (int)fmin(at, tp->cores - 2.0);
    double share = tp->core_share[i] + fmin(1.0, at - i) * (tp->core_share[i + 1] - tp->core_share[i]);
    return p->inlet_c + (p->core_c - p->inlet_c) / fmax(share, 1e-6);
}

double tempplan_free_wall_c(const struct tempplan *tp, double melt_c, double flow_mm3_s, double share)
{
    const struct tempplan_params *p = &tp->p;
    double wall_c = p->inlet_c + (melt_c - p->inlet_c) / greater(share, 1e-6);
    return isnan(p->core_c) ? wall_c : greater(wall_c, core_wall_c(tp, flow_mm3_s));
}

double tempplan_wall_for(const struct tempplan *tp, double melt_c, double flow_mm3_s, double share)
{
    return lesser(tp->p.ceiling_c, greater(tp->p.floor_c, tempplan_free_wall_c(tp, melt_c, flow_mm3_s, share)));
}

static double rate_k_s(const struct tempplan *tp, double start_c, double end_c, double melt_w_k, double holder_c)
{
    const struct tempplan_params *p = &tp->p;
    int floor_c = end_c > 0.0 ? (int)end_c : 0;
    if (floor_c > tp->degrees - 2)
        floor_c = tp->degrees - 2;
    double capacity_j_k = tp->capacity_j_k[floor_c + 1];
    double melt_w = melt_w_k * greater(0.0, end_c - p->inlet_c), holder_w = p->holder_w_k * (end_c - holder_c);
    if (end_c > start_c)
        return greater(MIN_RATE_K_S, (p->power_w - holder_w - tp->loss_w[floor_c + 1] - melt_w) / capacity_j_k);
    return greater(MIN_RATE_K_S, (holder_w + tp->loss_w[floor_c] + melt_w) / capacity_j_k);
}

/* -- plan: thermal/plan/set_points.py in the same order of sums -- */

static int same_request(const struct tempplan_piece *a, const struct tempplan_piece *b)
{
    return a->request_c == b->request_c || (isnan(a->request_c) && isnan(b->request_c));
}

/* The node that is being filled. */
struct filling {
    double from_s, at_s, longest_s;
    double weight, target, low, high, melt;        /* sums: weighted, and melt over time */
};

static int close_node(struct tempplan *tp, struct filling *f, int stretch)
{
    double lasted_s = f->at_s - f->from_s;
    if (lasted_s <= 1e-9)
        return 0;
    struct best_node *node = best_more(&tp->path);
    if (!node)
        return -1;
    int counts = f->weight > 0.0;
    node->time_s = 0.5 * (f->from_s + f->at_s);
    node->weight = f->weight;
    node->wanted_c = counts ? f->target / f->weight : 0.0;
    node->low_c = counts ? f->low / f->weight : tp->p.floor_c;
    node->high_c = counts ? f->high / f->weight : tp->p.ceiling_c;
    node->melt_w_k = f->melt / lasted_s;
    node->stretch = stretch;
    *f = (struct filling){ .from_s = f->at_s, .at_s = f->at_s, .longest_s = f->longest_s };
    return 0;
}

/* The piece lasts until until_s; NULL: a gap. Every mm of path counts as much as any other. */
static int fill(struct tempplan *tp, struct filling *f, double until_s, const struct tempplan_piece *q, int stretch)
{
    double wanted_c = 0.0, low_c = 0.0, high_c = 0.0, weight_per_s = 0.0, melt_w_k = 0.0;
    if (q && q->flow_mm3_s > 0.0) {
        wanted_c = q->wanted_c;
        double share = tp->shares[q - tp->pieces];
        melt_w_k = melt_heat_w_k(tp, q);
        double dx = q->end_pos[0] - q->start_pos[0], dy = q->end_pos[1] - q->start_pos[1];
        weight_per_s = share * share * sqrt(dx * dx + dy * dy) / greater(q->end_s - q->start_s, 1e-9);
        low_c = tempplan_wall_for(tp, tp->p.low_c, q->flow_mm3_s, share);
        high_c = tempplan_wall_for(tp, tp->p.high_c, q->flow_mm3_s, share);
    }
    while (f->at_s < until_s) {
        double end_s = f->from_s + f->longest_s, part_s = lesser(until_s, end_s) - f->at_s;
        double weight = weight_per_s * part_s;
        f->weight += weight;
        if (weight > 0.0) {
            f->target += weight * wanted_c;
            f->low += weight * low_c;
            f->high += weight * high_c;
        }
        f->melt += part_s * melt_w_k;
        f->at_s = until_s < end_s ? until_s : end_s;
        if (until_s >= end_s && close_node(tp, f, stretch))
            return -1;
    }
    return 0;
}

/* Pieces to nodes, earlier by the lag between nozzle and melt. What is asked for by name begins with a node. */
static int fill_nodes(struct tempplan *tp, int first, double from_s)
{
    int stretch = 0;
    double longest_s = fmax(NODE_S, (tp->pieces[tp->count - 1].end_s - from_s) / MAX_NODES);
    struct filling f = { .from_s = from_s, .at_s = from_s, .longest_s = longest_s };
    tp->path.count = 0;
    for (int i = first; i < tp->count; i++) {
        const struct tempplan_piece *q = &tp->pieces[i];
        double lag = tempplan_lag_s(&tp->p, q->flow_mm3_s);
        if (fill(tp, &f, q->start_s - lag, NULL, stretch))
            return -1;
        if (i > first && !same_request(q - 1, q) && close_node(tp, &f, stretch++))
            return -1;
        if (fill(tp, &f, q->end_s - lag, q, stretch))
            return -1;
    }
    return close_node(tp, &f, stretch);
}

/* The window's bounds depend on the flow: averaged over smooth_s to both sides, within a stretch of the same request. A
 * nozzle that kept to the lower bound of each corner would climb and never come down. */
static void smooth_bounds(struct tempplan *tp)
{
    struct best_node *nodes = tp->path.nodes;
    int low = 0, high = 0, count = tp->path.count;
    double weight = 0.0, low_sum = 0.0, high_sum = 0.0;
    for (int i = 0; i < count; i++) {
        struct best_node *node = &nodes[i];
        if (i && node->stretch != node[-1].stretch) {
            low = high = i;
            weight = low_sum = high_sum = 0.0;
        }
        double from_s = node->time_s - tp->p.smooth_s, until_s = node->time_s + tp->p.smooth_s;
        for (; high < count && nodes[high].stretch == node->stretch && nodes[high].time_s <= until_s; high++) {
            weight += nodes[high].weight;
            low_sum += nodes[high].weight * nodes[high].low_c;
            high_sum += nodes[high].weight * nodes[high].high_c;
        }
        for (; nodes[low].time_s < from_s; low++) {
            weight -= nodes[low].weight;
            low_sum -= nodes[low].weight * nodes[low].low_c;
            high_sum -= nodes[low].weight * nodes[low].high_c;
        }
        node->bound_low_c = node->weight > 0.0 ? low_sum / weight : node->low_c;
        node->bound_high_c = node->weight > 0.0 ? high_sum / weight : node->high_c;
    }
}

/* As M104 at the border of each piece would have it: nodes at the borders, and nothing known ahead. */
static int steps_at_borders(struct tempplan *tp, int first)
{
    tp->path.count = 0;
    for (int i = first; i < tp->count; i++) {
        struct best_node *node = best_more(&tp->path);
        if (!node)
            return -1;
        node->time_s = tp->pieces[i].start_s;
        node->temp_c = tp->pieces[i].wall_c;
    }
    return 0;
}

static double best_rate_k_s(const void *nozzle, double start_c, double end_c, double melt_w_k)
{
    const struct tempplan *tp = nozzle;
    return rate_k_s(tp, start_c, end_c, melt_w_k, tp->holder_c);
}

static int find_path(struct tempplan *tp, int first, double from_s, double start_c)
{
    if (tp->p.preview == 0.0)
        return steps_at_borders(tp, first);
    if (fill_nodes(tp, first, from_s))
        return -1;
    smooth_bounds(tp);
    best_solve(&tp->path, from_s, start_c, best_rate_k_s, tp);
    return 0;
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

/* A corner, or the last straight line grows. */
static int extend(struct tempplan *tp, double time_s, double temp_c)
{
    struct tempplan_point *last = &tp->points[tp->point_count - 1];
    if (time_s <= last->time_s) {
        last->temp_c = temp_c;
        return 0;
    }
    double slope = (temp_c - last->temp_c) / (time_s - last->time_s);
    if (tp->line_from < tp->point_count - 1) {
        const struct tempplan_point *from = &tp->points[tp->point_count - 2];
        double before = (last->temp_c - from->temp_c) / (last->time_s - from->time_s);
        if (fabs(slope - before) < SAME_SLOPE_K_S) {
            *last = (struct tempplan_point){ time_s, temp_c };
            return 0;
        }
    }
    return add_point(tp, time_s, temp_c);
}

/* Towards target_c, which is to be reached at by_s (or as soon as may be), until until_s. */
static int ramp(struct tempplan *tp, double now_s, double *now_c, double until_s, double target_c, double by_s,
                double melt_w_k, double *holder_c)
{
    while (now_s < until_s) {
        double left_c = target_c - *now_c, before_s = now_s, before_c = *now_c;
        double step_c = lesser(PIECE_C, greater(-PIECE_C, left_c));
        double rate = rate_k_s(tp, *now_c, *now_c + step_c, melt_w_k, *holder_c);
        if (by_s > now_s)
            rate = lesser(rate, fabs(left_c) / (by_s - now_s));
        double needed_s = rate > 0.0 ? fabs(step_c) / rate : 0.0;
        if (fabs(left_c) <= 1e-9) {
            now_s = until_s;
        } else if (now_s + needed_s > until_s) {
            *now_c += copysign(rate * (until_s - now_s), step_c);
            now_s = until_s;
        } else {
            now_s += needed_s;
            *now_c += step_c;
        }
        if (extend(tp, now_s, *now_c))
            return -1;
        *holder_c = holder_after(tp, *holder_c, 0.5 * (before_c + *now_c), now_s - before_s);
    }
    return 0;
}

static int follow(struct tempplan *tp, int first, double from_s, double start_c)
{
    double now_s = from_s, now_c = start_c, holder_c = tp->holder_c;
    double target_c = fmin(tp->p.ceiling_c, fmax(tp->p.floor_c, start_c)), by_s = from_s;
    double end_s = tp->pieces[tp->count - 1].end_s;
    const struct best_node *nodes = tp->path.nodes;
    int flow = first, turn = 0, ahead = tp->p.preview != 0.0;
    if (add_point(tp, now_s, now_c))
        return -1;
    tp->line_from = tp->point_count - 1;
    while (now_s < end_s) {
        while (turn < tp->path.count && nodes[turn].time_s <= now_s)
            target_c = nodes[turn++].temp_c;
        while (flow < tp->count - 1 && tp->pieces[flow].end_s <= now_s)
            flow++;
        const struct tempplan_piece *q = &tp->pieces[flow];
        int inside = q->start_s <= now_s;
        double border_s = lesser(inside ? q->end_s : q->start_s, end_s);
        if (turn < tp->path.count) {
            border_s = lesser(border_s, nodes[turn].time_s);
            if (ahead) {
                target_c = nodes[turn].temp_c;
                by_s = nodes[turn].time_s;
            }
        }
        double melt_w_k = inside ? melt_heat_w_k(tp, q) : 0.0;
        if (ramp(tp, now_s, &now_c, border_s, target_c, by_s, melt_w_k, &holder_c))
            return -1;
        now_s = border_s;
    }
    return 0;
}

/* Corners of it, 0: nothing lies ahead. */
static int make(struct tempplan *tp, double from_s, double start_c)
{
    int first = 0;
    while (first < tp->count && tp->pieces[first].end_s <= from_s)
        first++;
    if (first == tp->count)
        return 0;
    bring_holder(tp, from_s, start_c);
    if (find_path(tp, first, from_s, start_c))
        return 0;
    /* what was planned up to from_s stays: pieces not yet recorded look back at it */
    while (tp->point_count && tp->points[tp->point_count - 1].time_s >= from_s)
        tp->point_count--;
    int kept = tp->point_count;
    if (follow(tp, first, from_s, start_c)) {
        tp->point_count = kept;
        return 0;
    }
    return tp->point_count;
}

/* Number of the first of these points later than time_s. */
static int point_after(const struct tempplan_point *points, int count, double time_s)
{
    int low = 0, high = count;
    while (low < high) {
        int middle = (low + high) / 2;
        if (points[middle].time_s <= time_s)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

/* A line from the newest corner given out may go on as long as it can pass all points since at within_c. */
static int thin_out(const struct tempplan *tp, double since_s, double within_c, struct tempplan_point *out)
{
    int i = point_after(tp->points, tp->point_count, since_s), count = 0;
    i -= i > 0;
    if (i == tp->point_count)
        return 0;
    out[count++] = tp->points[i++];
    double low = -INFINITY, high = INFINITY;    /* slopes that it may have, K/s */
    for (; i < tp->point_count; i++) {
        const struct tempplan_point *a = &out[count - 1], *b = &tp->points[i];
        double past_s = b->time_s - a->time_s, slope = (b->temp_c - a->temp_c) / past_s;
        if (within_c > 0.0 && past_s > 0.0 && slope >= low && slope <= high) {
            low = greater(low, slope - within_c / past_s);
            high = lesser(high, slope + within_c / past_s);
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

static int reserve_corners(struct tempplan *tp, int count)
{
    if (count <= tp->corner_room)
        return 0;
    struct tempplan_point *grown = realloc(tp->corners, 2 * count * sizeof(*grown));
    if (!grown)
        return -1;
    tp->corners = grown;
    tp->corner_room = 2 * count;
    return 0;
}

int tempplan_make(struct tempplan *tp, double from_s, double start_c, double within_c)
{
    int count = isnan(start_c) ? 0 : make(tp, from_s, start_c);
    if (!count || reserve_corners(tp, count))
        return 0;
    return tp->corner_count = thin_out(tp, from_s - KEPT_S, within_c, tp->corners);
}

int tempplan_lead(struct tempplan *tp, const struct tempplan_point *points, int count)
{
    if (reserve_corners(tp, count))
        return -1;
    while (tp->point_count && tp->points[tp->point_count - 1].time_s >= points[0].time_s)
        tp->point_count--;
    for (int i = 0; i < count; i++)
        if (add_point(tp, points[i].time_s, points[i].temp_c))
            return -1;
    memcpy(tp->corners, points, count * sizeof(*points));
    tp->corner_count = count;
    return 0;
}

const struct tempplan_point *tempplan_corners(const struct tempplan *tp)
{
    return tp->corners;
}

double tempplan_holder(struct tempplan *tp, double time_s, double nozzle_c)
{
    bring_holder(tp, time_s, nozzle_c);
    return tp->holder_c;
}

static double on_the_way_c(const struct tempplan_point *points, int count, double time_s)
{
    int after = point_after(points, count, time_s);
    if (!after)
        return points[0].temp_c;
    if (after == count)
        return points[after - 1].temp_c;
    const struct tempplan_point *a = &points[after - 1], *b = &points[after];
    return a->temp_c + (b->temp_c - a->temp_c) * (time_s - a->time_s) / (b->time_s - a->time_s);
}

double tempplan_at(const struct tempplan *tp, double time_s, double otherwise_c)
{
    return tp->point_count ? on_the_way_c(tp->points, tp->point_count, time_s) : otherwise_c;
}

double tempplan_led(const struct tempplan *tp, double time_s)
{
    return tp->corner_count ? on_the_way_c(tp->corners, tp->corner_count, time_s) : NAN;
}
