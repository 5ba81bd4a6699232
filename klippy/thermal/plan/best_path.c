/* The best path that the nozzle can go; see best_path.h, and thermal/plan/set_points.py for the theory. */
#include "best_path.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { FIRST_NODES = 64, KNOTS_PER_NODE = 3 };  /* two knots a node, and one more if it lies at a bound */

static double between(double value, double low, double high)
{
    value = value > low ? value : low;      /* as fmax and fmin without their call; nothing is NaN */
    return value < high ? value : high;
}

static struct knot true_knot(const struct flank *f)
{
    struct knot raw = f->knots[f->count - 1];
    double at_c = raw.at_c + f->shift;
    return (struct knot){ at_c, raw.slope + f->gain * at_c + f->offset };
}

static void push(struct flank *f, double at_c, double slope)
{
    f->knots[f->count++] = (struct knot){ at_c - f->shift, slope - f->gain * at_c - f->offset };
}

/* Every knot moves; its value stays. */
static void move(struct flank *f, double by_c)
{
    f->shift += by_c;
    f->offset -= f->gain * by_c;
}

/* The derivative of weight/2 (T - target)^2 comes on top. */
static void add_square(struct flank *f, const struct best_node *node)
{
    f->gain += node->weight;
    f->offset -= node->weight * node->wanted_c;
}

struct best_node *best_more(struct best_path *path)
{
    if (path->count == path->room) {
        int room = path->room ? 2 * path->room : FIRST_NODES;
        struct best_node *nodes = realloc(path->nodes, room * sizeof(*nodes));
        if (nodes)
            path->nodes = nodes;
        struct knot *below = realloc(path->below.knots, (KNOTS_PER_NODE * room + 2) * sizeof(*below));
        if (below)
            path->below.knots = below;
        struct knot *above = realloc(path->above.knots, (KNOTS_PER_NODE * room + 2) * sizeof(*above));
        if (above)
            path->above.knots = above;
        if (!nodes || !below || !above)
            return NULL;
        path->room = room;
    }
    struct best_node *node = &path->nodes[path->count++];
    memset(node, 0, sizeof(*node));
    return node;
}

/* Where the derivative is zero; low_c or high_c if it rises or falls on all that can be reached. Knots change sides. */
static double find_zero(struct best_path *path, double low_c, double high_c)
{
    struct flank *below = &path->below, *above = &path->above;
    struct knot a, b;
    while (below->count && (a = true_knot(below)).slope > 0.0) {
        below->count--;
        push(above, a.at_c, a.slope);
    }
    while (above->count && (b = true_knot(above)).slope < 0.0) {
        above->count--;
        push(below, b.at_c, b.slope);
    }
    if (!below->count)
        return low_c;
    if (!above->count)
        return high_c;
    a = true_knot(below);
    b = true_knot(above);
    return b.slope > a.slope ? a.at_c + (b.at_c - a.at_c) * -a.slope / (b.slope - a.slope) : a.at_c;
}

/* The zero lies at or beyond a bound: what lies beyond is cut off. */
static void cut_off(struct flank *outer, struct flank *inner, double bound_c, double side)
{
    struct knot before = { bound_c, 0.0 };
    int has_before = outer->count > 0;
    if (has_before)
        before = true_knot(outer);
    outer->count = 0;
    for (; inner->count; inner->count--) {
        struct knot next = true_knot(inner);
        if ((next.at_c - bound_c) * side > 0.0) {
            double share = (bound_c - before.at_c) / (next.at_c - before.at_c);
            if (has_before)
                push(inner, bound_c, before.slope + share * (next.slope - before.slope));
            return;
        }
        before = next;
        has_before = 1;
    }
}

static double best_of(struct best_path *path, double low_c, double high_c)
{
    double best_c = find_zero(path, low_c, high_c);
    if (best_c <= low_c)
        cut_off(&path->below, &path->above, low_c, 1.0);
    else if (best_c >= high_c)
        cut_off(&path->above, &path->below, high_c, -1.0);
    return best_c;
}

void best_solve(struct best_path *path, double from_s, double start_c, best_rate rate, const void *nozzle)
{
    path->below = (struct flank){ .knots = path->below.knots };
    path->above = (struct flank){ .knots = path->above.knots };
    double low_c = start_c, high_c = start_c, best_c = start_c;
    for (int i = 0; i < path->count; i++) {     /* the best end of all paths so far, and the cost of ending elsewhere */
        struct best_node *node = &path->nodes[i];
        double step_s = node->time_s - (i ? node[-1].time_s : from_s);
        node->fall_c = step_s * rate(nozzle, best_c, best_c, node->melt_w_k);
        node->rise_c = step_s * rate(nozzle, best_c - 1.0, best_c, node->melt_w_k);
        move(&path->below, -node->fall_c);
        move(&path->above, node->rise_c);
        push(&path->below, best_c - node->fall_c, 0.0);
        push(&path->above, best_c + node->rise_c, 0.0);
        add_square(&path->below, node);
        add_square(&path->above, node);
        double reach_low_c = low_c - node->fall_c, reach_high_c = high_c + node->rise_c;
        low_c = between(node->bound_low_c, reach_low_c, reach_high_c);
        high_c = between(node->bound_high_c, reach_low_c, reach_high_c);
        if (node->weight > 0.0)
            best_c = best_of(path, low_c, high_c);
        best_c = between(best_c, low_c, high_c);    /* without weight all that is near costs the same: stay */
        node->temp_c = best_c;
    }
    for (int i = path->count - 1; i > 0; i--) { /* and back from the best end of the last */
        const struct best_node *node = &path->nodes[i];
        double *before_c = &path->nodes[i - 1].temp_c;
        *before_c = between(*before_c, node->temp_c - node->rise_c, node->temp_c + node->fall_c);
    }
}

void best_free(struct best_path *path)
{
    free(path->nodes);
    free(path->below.knots);
    free(path->above.knots);
}
