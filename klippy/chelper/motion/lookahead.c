/* Look-ahead: see lookahead.h, and klippy/lookahead.py for the method. */
#include "lookahead.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "trapq.h"

enum { INITIAL_CAPACITY = 256 };
/* Junction angles this close to straight or to full reversal are treated as such: the formulas divide by them. */
#define ANGLE_EPSILON 1e-9

static double
lesser(double a, double b)
{
    return b < a ? b : a;
}

static int
resize(struct lookahead *la, size_t capacity)
{
    struct lookahead_move *ring = malloc(capacity * sizeof(*ring));
    double *entry = malloc((capacity + 1) * sizeof(*entry));
    double *smoothed = malloc((capacity + 1) * sizeof(*smoothed));
    if (!ring || !entry || !smoothed) {
        free(ring);
        free(entry);
        free(smoothed);
        return -1;
    }
    for (uint64_t n = la->first; n < la->next; n++)
        ring[n & (capacity - 1)] = *lookahead_move_at(la, n);
    free(la->ring);
    free(la->entry);
    free(la->smoothed);
    la->ring = ring;
    la->entry = entry;
    la->smoothed = smoothed;
    la->mask = capacity - 1;
    return 0;
}

struct lookahead *
lookahead_alloc(double review_s)
{
    struct lookahead *la = calloc(1, sizeof(*la));
    if (!la)
        return NULL;
    if (resize(la, INITIAL_CAPACITY)) {
        free(la);
        return NULL;
    }
    la->review_s = la->until_review_s = review_s;
    return la;
}

void
lookahead_free(struct lookahead *la)
{
    if (!la)
        return;
    free(la->ring);
    free(la->entry);
    free(la->smoothed);
    free(la);
}

void
lookahead_reset(struct lookahead *la)
{
    la->first = la->next;
    la->until_review_s = la->review_s;
}

/* Highest squared speed through the corner between two moves; infinite if it does not bend.
 *
 * Next to a move of the extruder alone the head stands still: 0.
 *
 * A circle in the corner touches both lines. It is run at the speed whose centripetal acceleration is allowed:
 * v^2 = a*R. With theta the angle between the lines (pi: straight on),
 *   - the circle that comes within junction_deviation of the corner has R = dev * s/(1-s), s = sin(theta/2);
 *   - the circle that touches the lines half a move away from the corner has R = d/2 * tan(theta/2). */
static double
corner_v2(const struct lookahead_move *prev, const struct lookahead_move *move)
{
    if (prev->is_kinematic_move == 0. || move->is_kinematic_move == 0.)
        return 0.;
    const double *a = prev->axes_r, *b = move->axes_r;
    double cos_theta = -(a[0] * b[0] + a[1] * b[1] + a[2] * b[2]);
    if (cos_theta > 1. - ANGLE_EPSILON)         /* back on itself */
        return 0.;
    double half = .5 * (1. - cos_theta);        /* sin^2(theta/2) */
    if (half > 1. - ANGLE_EPSILON)              /* straight on */
        return INFINITY;
    double sin_half = sqrt(half);
    double tangent_v2 = .5 * sin_half / sqrt(1. - half);        /* per mm and unit acceleration */
    double deviation_v2 = sin_half / (1. - sin_half);
    return lesser(
        deviation_v2 * lesser(move->junction_deviation * move->accel, prev->junction_deviation * prev->accel),
        tangent_v2 * lesser(move->move_d * move->accel, prev->move_d * prev->accel));
}

/* Set the highest entry speed of `move` after `prev`. */
static void
follow(struct lookahead_move *move, const struct lookahead_move *prev, double extruder_v2)
{
    double limit = lesser(prev->max_cruise_v2, move->max_cruise_v2);
    limit = lesser(limit, prev->max_start_v2 + prev->delta_v2);
    limit = lesser(limit, extruder_v2);
    limit = lesser(limit, corner_v2(prev, move));
    move->max_start_v2 = limit;
    move->max_smoothed_v2 = lesser(limit, prev->max_smoothed_v2 + prev->smooth_delta_v2);
}

/* A move takes at least this long (s): it speeds up from its highest entry speed, and need not brake. */
static double
shortest_s(const struct lookahead_move *m)
{
    double top_v2 = lesser(m->max_cruise_v2, m->max_start_v2 + m->delta_v2), top_v = sqrt(top_v2);
    double accel_d = .5 * (top_v2 - m->max_start_v2) / m->accel;
    return (top_v - sqrt(m->max_start_v2)) / m->accel + (m->move_d - accel_d) / top_v;
}

int
lookahead_add(struct lookahead *la, const struct lookahead_move *source, double extruder_v2)
{
    if (la->next - la->first > la->mask && resize(la, (la->mask + 1) * 2))
        abort();
    struct lookahead_move *move = lookahead_move_at(la, la->next);
    *move = *source;
    move->max_start_v2 = move->max_smoothed_v2 = 0.;
    if (la->next > la->first)
        follow(move, lookahead_move_at(la, la->next - 1), extruder_v2);
    la->next++;
    la->until_review_s -= shortest_s(move);
    return la->until_review_s <= 0.;
}

/* Fix the speeds; works out the three times. */
static void
set_speeds(struct lookahead_move *m, double start_v2, double cruise_v2, double end_v2)
{
    double per_v2 = .5 / m->accel;
    double accel_d = (cruise_v2 - start_v2) * per_v2;
    double decel_d = (cruise_v2 - end_v2) * per_v2;
    double cruise_d = m->move_d - accel_d - decel_d;
    m->start_v = sqrt(start_v2);
    m->cruise_v = sqrt(cruise_v2);
    m->end_v = sqrt(end_v2);
    m->accel_t = accel_d / ((m->start_v + m->cruise_v) * .5);
    m->cruise_t = cruise_d > 0. ? cruise_d / m->cruise_v : 0.;
    m->decel_t = decel_d / ((m->end_v + m->cruise_v) * .5);
}

/* Entry speeds squared, real and smoothed, of every move and (0) of what follows the last. */
static void
speed_profiles(struct lookahead *la, int count)
{
    double v2 = 0., s2 = 0.;
    la->entry[count] = la->smoothed[count] = 0.;
    for (int i = count - 1; i >= 0; i--) {
        const struct lookahead_move *m = lookahead_move_at(la, la->first + i);
        la->entry[i] = v2 = lesser(v2 + m->delta_v2, m->max_start_v2);
        la->smoothed[i] = s2 = lesser(s2 + m->smooth_delta_v2, m->max_smoothed_v2);
    }
}

/* How many moves no later move can change any more: those before a valley whose depth is set by the corner
 * itself, in both profiles, and not by the need to brake. */
static int
settled_count(const struct lookahead *la, int count)
{
    for (int i = count - 1; i > 0; i--) {
        const struct lookahead_move *m = lookahead_move_at(la, la->first + i);
        const struct lookahead_move *prev = lookahead_move_at(la, la->first + i - 1);
        if (la->smoothed[i] >= m->max_smoothed_v2 && la->entry[i] >= m->max_start_v2
            && la->smoothed[i] < la->smoothed[i - 1] + prev->smooth_delta_v2)
            return i;
    }
    return 0;
}

/* Fix the moves first..last, the falling side of a hill: never faster than before. */
static void
run_downhill(struct lookahead *la, int first, int last, double cap)
{
    for (int i = first; i <= last; i++) {
        cap = lesser(cap, la->entry[i]);
        set_speeds(lookahead_move_at(la, la->first + i), cap, cap, lesser(la->entry[i + 1], cap));
    }
}

int
lookahead_plan(struct lookahead *la, int lazy)
{
    int all = (int)(la->next - la->first);
    la->until_review_s = la->review_s;
    speed_profiles(la, all);
    int count = lazy ? settled_count(la, all) : all;
    const double *entry = la->entry, *smoothed = la->smoothed;
    double top_v2 = 0.;
    int falling_end = -1;           /* last move of a falling side whose top is not reached yet */
    for (int i = count - 1; i >= 0; i--) {
        struct lookahead_move *m = lookahead_move_at(la, la->first + i);
        double reachable = smoothed[i + 1] + m->smooth_delta_v2;
        if (smoothed[i] >= reachable) {         /* braking through: belongs to a falling side */
            if (falling_end < 0)
                falling_end = i;
            continue;
        }
        if (falling_end >= 0 || smoothed[i] + m->smooth_delta_v2 > smoothed[i + 1]) {
            top_v2 = lesser(m->max_cruise_v2, .5 * (smoothed[i] + reachable));
            if (falling_end >= 0)
                run_downhill(la, i + 1, falling_end, top_v2);
            falling_end = -1;
        }
        double start_v2 = entry[i], end_v2 = entry[i + 1];
        double cruise_v2 = lesser(lesser(.5 * (start_v2 + end_v2 + m->delta_v2), m->max_cruise_v2), top_v2);
        set_speeds(m, lesser(start_v2, cruise_v2), cruise_v2, lesser(end_v2, cruise_v2));
    }
    return count;
}

void
lookahead_drop(struct lookahead *la, int count)
{
    la->first += count;
}

double
lookahead_commit(struct lookahead *la, int count, double print_time, struct trapq *tq,
                 struct trapq *extruder_tq, double *filament_pos)
{
    for (int i = 0; i < count; i++) {
        const struct lookahead_move *m = lookahead_move_at(la, la->first + i);
        if (m->is_kinematic_move != 0.)
            trapq_append(tq, print_time, m->accel_t, m->cruise_t, m->decel_t,
                         m->start_pos[0], m->start_pos[1], m->start_pos[2],
                         m->axes_r[0], m->axes_r[1], m->axes_r[2], m->start_v, m->cruise_v, m->accel);
        if (m->axes_d[3] != 0. && extruder_tq) {
            /* pressure advance acts where filament is deposited along a line */
            int advances = m->axes_r[3] > 0. && (m->axes_d[0] != 0. || m->axes_d[1] != 0.);
            trapq_append(extruder_tq, print_time, m->accel_t, m->cruise_t, m->decel_t,
                         *filament_pos, 0., 0., m->axes_r[3], advances, 0., m->start_v, m->cruise_v, m->accel);
            *filament_pos += m->axes_d[3];
        }
        print_time += m->accel_t + m->cruise_t + m->decel_t;
    }
    lookahead_drop(la, count);
    return print_time;
}
