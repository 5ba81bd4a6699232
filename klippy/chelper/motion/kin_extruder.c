/*
 * The extruder: filament position with smoothed pressure advance.
 *
 * The extruder has a queue of its own: coordinate 0 is the filament fed (mm), ratio[1] = 1 marks motion to which
 * pressure advance applies. The pressure model wants p(t) = e(t) + K*e'(t); what the motor gets is p averaged over
 * +-w (half the smooth time) with a triangular weight:
 *
 *     s(t) = 1/w^2 * integral of p(t+u) * (w - |u|) du,  u = -w..w
 *          = ( Q(t+w) - 2 Q(t) + Q(t-w) ) / w^2          with Q'' = p
 *
 * p is made of quadratics, so Q is made of quartics, and so is s between the times at which t-w, t or t+w passes
 * from one segment into the next. next_piece() works out that quartic, with time and filament counted from the
 * start of the piece: the differences would drown in rounding otherwise.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "kinematics.h"

/* An edge this close to the end of a segment counts as past it: keeps pieces longer than rounding of print_time. */
#define SHORTEST_PIECE_S 1e-9

struct extruder {
    struct stepper_kinematics sk;   /* first: the two are one object */
    double advance_s, half_window_s;
};

/* What is known of p over a stretch of time: p = p[0] + p[1]*t + p[2]*t^2 until `end`. */
struct stretch {
    double end;
    double p[3];
};

/* The motion around print_time: the segment it lies in, or the rest before segment `*number`. `*number` is where to
 * look first and ends at the segment found. Times in the result count from `zero`, filament from `filament_zero`. */
static struct stretch
stretch_at(const struct extruder *ex, uint64_t *number, double print_time, double zero, double filament_zero)
{
    const struct trapq *tq = ex->sk.tq;
    while (*number < tq->next) {
        const struct segment *s = trapq_segment(tq, *number);
        if (print_time < s->start_time + s->duration)
            break;
        ++*number;
    }
    struct stretch out = { .end = INFINITY };
    const struct segment *s = *number < tq->next ? trapq_segment(tq, *number) : NULL;
    if (s && print_time >= s->start_time) {
        double t = zero - s->start_time, r = s->ratio[0], k = s->ratio[1] != 0. ? ex->advance_s : 0.;
        double v = r * (s->speed + 2. * s->half_accel * t), h = r * s->half_accel;
        out.p[0] = s->origin[0] - filament_zero + r * (s->speed + s->half_accel * t) * t + k * v;
        out.p[1] = v + 2. * h * k;
        out.p[2] = h;
        out.end = s->start_time + s->duration;
        return out;
    }
    if (s)
        out.end = s->start_time;
    if (*number > tq->first) {      /* at rest where the segment before ended */
        const struct segment *before = trapq_segment(tq, *number - 1);
        double t = before->duration;
        out.p[0] = before->origin[0] + before->ratio[0] * (before->speed + before->half_accel * t) * t;
    } else if (s) {
        out.p[0] = s->origin[0];
    }
    out.p[0] -= filament_zero;
    return out;
}

/* Twice integrated p as q[0..4], given value and slope at the time `at` where it starts. */
static void
integrate_twice(const double *p, double at, double value, double slope, double *q)
{
    q[4] = p[2] / 12.;
    q[3] = p[1] / 6.;
    q[2] = p[0] / 2.;
    q[1] = slope - (2. * q[2] + (3. * q[3] + 4. * q[4] * at) * at) * at;
    q[0] = value - (q[1] + (q[2] + (q[3] + q[4] * at) * at) * at) * at;
}

static double
quartic_value(const double *q, double t)
{
    return q[0] + (q[1] + (q[2] + (q[3] + q[4] * t) * t) * t) * t;
}

static double
quartic_slope(const double *q, double t)
{
    return q[1] + (2. * q[2] + (3. * q[3] + 4. * q[4] * t) * t) * t;
}

/* sum += factor * q(t + shift) */
static void
add_shifted(double *sum, const double *q, double shift, double factor)
{
    double c[5];
    memcpy(c, q, sizeof(c));
    for (int i = 0; i < 4; i++)     /* Taylor shift by repeated synthetic division */
        for (int j = 3; j >= i; j--)
            c[j] += shift * c[j + 1];
    for (int i = 0; i < 5; i++)
        sum[i] += factor * c[i];
}

/* First segment that ends after print_time, searched from the reader: the reader trails by the window. */
static uint64_t
trailing_segment(struct stepper_kinematics *sk, double print_time)
{
    const struct trapq *tq = sk->tq;
    for (; sk->reader < tq->next; sk->reader++) {
        const struct segment *s = trapq_segment(tq, sk->reader);
        if (s->start_time + s->duration > print_time)
            break;
    }
    return sk->reader;
}

/* Q over the stretches from print_time t-w to t+w (w = window), all with time counted from `from`: the quartics valid
 * at the left edge, in the middle and at the right edge. Returns how long these three stay valid. */
static double
quartics_around(struct extruder *ex, uint64_t number, double from, double filament_zero, double q[3][5])
{
    double w = ex->half_window_s, valid = INFINITY, value = 0., slope = 0.;
    double at = from - w;
    for (int edge = 0; edge < 3; edge++) {
        double target = w * (edge - 1);
        for (;;) {
            struct stretch s = stretch_at(ex, &number, at, from, filament_zero);
            double end = s.end - from;
            integrate_twice(s.p, at - from, value, slope, q[edge]);
            if (end > target + SHORTEST_PIECE_S) {
                valid = fmin(valid, end - target);
                break;
            }
            value = quartic_value(q[edge], end);
            slope = quartic_slope(q[edge], end);
            at = s.end;
        }
    }
    return valid;
}

static int
smoothed_next_piece(struct stepper_kinematics *sk, double from, double until, struct motion_piece *out)
{
    struct extruder *ex = (struct extruder *)sk;
    double w = ex->half_window_s;
    if (!(w > 0.))
        return linear_next_piece(sk, from, until, out);
    const struct trapq *tq = sk->tq;
    uint64_t number = trailing_segment(sk, from - w);
    if (number == tq->next)
        return 0;
    const struct segment *s = trapq_segment(tq, number);
    if (s->start_time - w > from)
        from = s->start_time - w;
    if (from >= until)
        return 0;

    double q[3][5], filament_zero = s->origin[0];
    double valid = quartics_around(ex, number, from, filament_zero, q);
    memset(out->c, 0, sizeof(out->c));
    double scale = 1. / (w * w);
    add_shifted(out->c, q[0], -w, scale);
    add_shifted(out->c, q[1], 0., -2. * scale);
    add_shifted(out->c, q[2], w, scale);
    out->c[0] += filament_zero;
    out->start = from;
    out->end = fmin(until, from + valid);
    out->degree = 4;
    return 1;
}

struct stepper_kinematics *
extruder_stepper_alloc(void)
{
    struct extruder *ex = calloc(1, sizeof(*ex));
    if (!ex)
        return NULL;
    ex->sk.next_piece = smoothed_next_piece;
    ex->sk.position = linear_position;
    ex->sk.mix[0] = 1.;
    ex->sk.axes = 1u;
    return (struct stepper_kinematics *)ex;     /* not &ex->sk, which gcc's analyzer takes for a leak of ex */
}

/* Takes effect from the steps not yet generated on; call it with the extruder at rest. */
void
extruder_set_pressure_advance(struct stepper_kinematics *sk, double advance_s, double smooth_time_s)
{
    struct extruder *ex = (struct extruder *)sk;
    ex->advance_s = advance_s;
    ex->half_window_s = advance_s > 0. ? .5 * smooth_time_s : 0.;
    sk->look_behind = sk->look_ahead = ex->half_window_s;
    if (sk->tq)
        sk->reader = sk->tq->next;      /* what was done before is not done again in a longer window */
}
