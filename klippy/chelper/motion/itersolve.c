/* Step times of one stepper from the queue of planned motion: overview in itersolve.h. */
#include "itersolve.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "stepcompress.h"

enum { NEWTON_TRIES = 30 };
#define ROOT_PRECISION_S 1e-9       /* far below a clock tick that matters */

/* ---- solving one monotone stretch ---- */

/* A stretch in which the stepper moves one way only, in units of steps and seconds after `start`. */
struct stretch {
    double start, from, to;                 /* start: print_time; from, to: relative to it */
    double c[PIECE_DEGREE_MAX + 1];
    int degree, dir;                        /* dir 1 forward, 0 backward */
};

static double
value_at(const double *c, int degree, double t)
{
    double v = c[degree];
    for (int i = degree - 1; i >= 0; i--)
        v = v * t + c[i];
    return v;
}

static double
slope_at(const double *c, int degree, double t)
{
    double v = degree * c[degree];
    for (int i = degree - 1; i >= 1; i--)
        v = v * t + i * c[i];
    return v;
}

/* Closed form. In the direction of motion with speed v >= 0 and half acceleration h the way D is done at
 * t = 2D / (v + sqrt(v^2 + 4hD)): good for any sign of h, and without cancellation. */
static void
quadratic_times(const struct stretch *s, double first_edge, size_t count, double *clocks, struct step_time_map map)
{
    double sign = s->dir ? 1. : -1.;
    double v = sign * (s->c[1] + 2. * s->c[2] * s->from), h = sign * s->c[2];
    double way = sign * (first_edge - value_at(s->c, 2, s->from));
    double base = (s->start + s->from - map.time_offset) * map.freq;
    double longest = s->to - s->from;
    if (v < 0.)
        v = 0.;
    for (size_t i = 0; i < count; i++) {
        double d = way + (double)i;
        d = d > 0. ? d : 0.;
        double root = v * v + 4. * h * d;
        double t = 2. * d / (v + sqrt(root > 0. ? root : 0.));
        t = t < longest ? t : longest;      /* rounding at the very end; also catches 0/0 */
        clocks[i] = base + t * map.freq;
    }
}

/* Bracketed Newton: each root starts from the one before and never leaves [low, to]. */
static void
polynomial_times(const struct stretch *s, double first_edge, size_t count, double *clocks, struct step_time_map map)
{
    double sign = s->dir ? 1. : -1.;
    double low = s->from, t = s->from;
    for (size_t i = 0; i < count; i++) {
        double edge = first_edge + sign * (double)i, high = s->to;
        for (int attempt = 0; attempt < NEWTON_TRIES; attempt++) {
            double miss = sign * (value_at(s->c, s->degree, t) - edge);
            if (miss < 0.)
                low = t;
            else
                high = t;
            double slope = sign * slope_at(s->c, s->degree, t);
            double next = slope > 0. ? t - miss / slope : low - 1.;
            if (!(next >= low && next <= high))
                next = .5 * (low + high);
            double change = fabs(next - t);
            t = next;
            if (change < ROOT_PRECISION_S || high - low < ROOT_PRECISION_S)
                break;
        }
        clocks[i] = (s->start + t - map.time_offset) * map.freq;
        low = t;
    }
}

static int
solve_stretch(struct stepper_kinematics *sk, const struct stretch *s)
{
    double end = value_at(s->c, s->degree, s->to);
    double room = s->dir ? end - .5 : -end - .5;    /* edges lie half a step off the grid */
    int64_t here = s->dir ? sk->steps : -sk->steps;
    int64_t there = (int64_t)ceil(room);
    if (there <= here)
        return 0;
    size_t count = (size_t)(there - here), skip;
    double first_edge = (double)sk->steps + (s->dir ? .5 : -.5);
    struct step_time_map map = stepcompress_time_map(sk->sc);
    void (*times)(const struct stretch *, double, size_t, double *, struct step_time_map) =
        s->degree <= 2 ? quadratic_times : polynomial_times;

    double first_clock;
    times(s, first_edge, 1, &first_clock, map);
    double *clocks = stepcompress_reserve(sk->sc, s->dir, count, first_clock, &skip);
    if (!clocks)
        return STEPCOMPRESS_PAST;
    times(s, first_edge + (s->dir ? (double)skip : -(double)skip), count - skip, clocks, map);
    stepcompress_commit(sk->sc, count - skip);
    sk->steps = s->dir ? there : -there;
    return 0;
}

/* ---- from pieces to monotone stretches ---- */

/* Where the slope, itself monotone in [low, high], changes sign. */
static double
turning_point(const struct stretch *s, double low, double high)
{
    if (s->degree == 2)
        return -.5 * s->c[1] / s->c[2];
    int rising = slope_at(s->c, s->degree, high) > 0.;
    while (high - low > ROOT_PRECISION_S) {
        double middle = .5 * (low + high);
        if ((slope_at(s->c, s->degree, middle) > 0.) == rising)
            high = middle;
        else
            low = middle;
    }
    return .5 * (low + high);
}

/* Times at which the second derivative vanishes: between two of them the slope is monotone. */
static int
bends(const struct stretch *s, double *at)
{
    if (s->degree <= 2)
        return 0;
    double a = 12. * s->c[4], b = 6. * s->c[3], c = 2. * s->c[2];
    if (s->degree == 3)
        a = 0.;
    double root = b * b - 4. * a * c;
    if (root <= 0. && a != 0.)
        return 0;
    if (a == 0.) {
        at[0] = -c / b;
        return b != 0.;
    }
    double q = -.5 * (b + copysign(sqrt(root), b));
    at[0] = q / a;
    at[1] = q != 0. ? c / q : 0.;
    if (at[0] > at[1]) {
        double swap = at[0];
        at[0] = at[1];
        at[1] = swap;
    }
    return 2;
}

static int
solve_range(struct stepper_kinematics *sk, struct stretch *s, double from, double to)
{
    double slope_from = slope_at(s->c, s->degree, from), slope_to = slope_at(s->c, s->degree, to);
    double turn = to;
    if (slope_from * slope_to < 0.)
        turn = turning_point(s, from, to);
    s->from = from;
    s->to = turn;
    s->dir = turn < to ? slope_from > 0. : slope_from + slope_to > 0.;
    int ret = solve_stretch(sk, s);
    if (ret || turn >= to)
        return ret;
    s->from = turn;
    s->to = to;
    s->dir = slope_to > 0.;
    return solve_stretch(sk, s);
}

static int
solve_piece(struct stepper_kinematics *sk, const struct motion_piece *piece)
{
    struct stretch s = { .start = piece->start, .degree = piece->degree };
    double per_step = 1. / sk->step_dist;
    s.c[0] = (piece->c[0] - sk->origin) * per_step;
    for (int i = 1; i <= piece->degree; i++)
        s.c[i] = piece->c[i] * per_step;

    double at[2], from = 0., to = piece->end - piece->start;
    int count = bends(&s, at);
    for (int i = 0; i < count; i++) {
        if (!(at[i] > from && at[i] < to))
            continue;
        int ret = solve_range(sk, &s, from, at[i]);
        if (ret)
            return ret;
        from = at[i];
    }
    return solve_range(sk, &s, from, to);
}

/* ---- the stepper ---- */

/* Catch up with segments the queue has dropped at either end. */
static void
sync_reader(struct stepper_kinematics *sk)
{
    if (sk->reader < sk->tq->first)
        sk->reader = sk->tq->first;
    if (sk->reader > sk->tq->next)
        sk->reader = sk->tq->next;
    if (sk->barrier > sk->tq->next)
        sk->barrier = sk->tq->next;
}

int
itersolve_generate_steps(struct stepper_kinematics *sk, double until)
{
    if (until <= sk->done_time)
        return 0;
    if (sk->tq && sk->sc) {
        struct motion_piece piece;
        sync_reader(sk);
        while (sk->done_time < until && sk->next_piece(sk, sk->done_time, until, &piece)) {
            int ret = solve_piece(sk, &piece);
            if (ret)
                return ret;
            sk->done_time = piece.end;
        }
    }
    sk->done_time = until;
    return 0;
}

double
itersolve_check_active(struct stepper_kinematics *sk, double until)
{
    struct motion_piece piece;
    if (!sk->tq)
        return -1.;
    sync_reader(sk);
    if (!sk->next_piece(sk, sk->done_time, until, &piece))
        return -1.;
    return piece.start;
}

void
itersolve_free(struct stepper_kinematics *sk)
{
    free(sk);
}

void
itersolve_set_trapq(struct stepper_kinematics *sk, struct trapq *tq)
{
    sk->tq = tq;
    sk->reader = sk->barrier = tq ? tq->next : 0;
}

void
itersolve_set_stepcompress(struct stepper_kinematics *sk, struct stepcompress *sc, double step_dist)
{
    double here = sk->origin + (double)sk->steps * sk->step_dist;
    sk->sc = sc;
    sk->step_dist = step_dist;
    sk->origin = here - (double)sk->steps * step_dist;
}

/* From now on the place where the stepper stands is called x, y, z. */
void
itersolve_set_position(struct stepper_kinematics *sk, double x, double y, double z)
{
    const double xyz[3] = { x, y, z };
    sk->origin = sk->position(sk, xyz) - (double)sk->steps * sk->step_dist;
    if (sk->tq && sk->tq->next > sk->tq->first)
        sk->barrier = sk->tq->next - 1;     /* trapq_set_position() has put the new place there */
}

/* Take over a stepper that stands at `steps`: for this solver it is where the solver last had it. */
void
itersolve_adopt_steps(struct stepper_kinematics *sk, int64_t steps)
{
    sk->origin += (double)(sk->steps - steps) * sk->step_dist;
    sk->steps = steps;
}

/* The MCU says it stands at `steps`: same grid, other place. */
void
itersolve_set_steps(struct stepper_kinematics *sk, int64_t steps)
{
    sk->steps = steps;
}

int64_t
itersolve_get_steps(const struct stepper_kinematics *sk)
{
    return sk->steps;
}

double
itersolve_get_origin(const struct stepper_kinematics *sk)
{
    return sk->origin;
}

double
itersolve_calc_position_from_coord(const struct stepper_kinematics *sk, double x, double y, double z)
{
    const double xyz[3] = { x, y, z };
    return sk->position(sk, xyz);
}

int
itersolve_is_active_axis(const struct stepper_kinematics *sk, char axis)
{
    if (axis < 'x' || axis > 'z')
        return 0;
    return (int)(sk->axes >> (axis - 'x')) & 1;
}

double
itersolve_look_ahead(const struct stepper_kinematics *sk)
{
    return sk->look_ahead;
}
