/* The motion of the axes as a stepper sees it: segments of the queue, shaped if asked for; and linear machines. */
#include <math.h>
#include <string.h>

#include "itersolve.h"

/* An edge this close counts as passed: keeps pieces longer than the rounding of print_time. */
#define SHORTEST_PIECE_S 1e-9

static double
segment_end(const struct segment *s)
{
    return s->start_time + s->duration;
}

/* ---- not shaped ---- */

static int
plain_motion(struct stepper_kinematics *sk, double from, double until, struct axis_motion *out)
{
    const struct trapq *tq = sk->tq;
    for (; sk->reader < tq->next; sk->reader++) {
        const struct segment *s = trapq_segment(tq, sk->reader);
        double end = segment_end(s);
        if (s->start_time >= until)
            return 0;
        if (end <= from || s->duration <= 0.)
            continue;
        double t = from > s->start_time ? from - s->start_time : 0.;
        double way = (s->speed + s->half_accel * t) * t, speed = s->speed + 2. * s->half_accel * t;
        for (int k = 0; k < 3; k++) {
            out->c[k][0] = s->origin[k] + s->ratio[k] * way;
            out->c[k][1] = s->ratio[k] * speed;
            out->c[k][2] = s->ratio[k] * s->half_accel;
        }
        out->start = s->start_time + t;
        out->end = end < until ? end : until;
        return 1;
    }
    return 0;
}

/* ---- shaped ---- */

/* One axis from print_time on as a quadratic; returns the print_time until which it holds. */
static double
axis_at(const struct stepper_kinematics *sk, uint64_t *cursor, int axis, double print_time, double *c)
{
    const struct trapq *tq = sk->tq;
    uint64_t low = sk->barrier > tq->first ? sk->barrier : tq->first, number = *cursor;
    if (number > tq->next)
        number = tq->next;
    while (number > low && segment_end(trapq_segment(tq, number - 1)) > print_time)
        number--;
    if (number < low)
        number = low;
    while (number < tq->next && segment_end(trapq_segment(tq, number)) <= print_time + SHORTEST_PIECE_S)
        number++;
    *cursor = number;

    const struct segment *s = number < tq->next ? trapq_segment(tq, number) : NULL;
    c[1] = c[2] = 0.;
    if (s && print_time >= s->start_time - SHORTEST_PIECE_S) {
        double t = print_time - s->start_time, r = s->ratio[axis];
        c[0] = s->origin[axis] + r * (s->speed + s->half_accel * t) * t;
        c[1] = r * (s->speed + 2. * s->half_accel * t);
        c[2] = r * s->half_accel;
        return segment_end(s);
    }
    if (number > tq->first && (number > low || !s)) {   /* at rest where the segment before ended */
        const struct segment *before = trapq_segment(tq, number - 1);
        double t = before->duration;
        c[0] = before->origin[axis] + before->ratio[axis] * (before->speed + before->half_accel * t) * t;
    } else {
        c[0] = s ? s->origin[axis] : 0.;
    }
    return s ? s->start_time : INFINITY;
}

/* All axes from `from` on; returns whether any moves. */
static int
shaped_from(struct stepper_kinematics *sk, double from, struct axis_motion *out)
{
    int moves = 0;
    out->start = from;
    out->end = INFINITY;
    memset(out->c, 0, sizeof(out->c));
    for (int axis = 0; axis < 3; axis++) {
        struct axis_shaper *sh = &sk->shaper[axis];
        int copies = sh->count ? sh->count : 1;
        for (int i = 0; i < copies; i++) {
            double c[3], delay = sh->count ? sh->delay[i] : 0., weight = sh->count ? sh->weight[i] : 1.;
            double valid = axis_at(sk, &sh->cursor[i], axis, from - delay, c) + delay;
            if (valid < out->end)
                out->end = valid;
            for (int j = 0; j < 3; j++)
                out->c[axis][j] += weight * c[j];
            moves |= c[1] != 0. || c[2] != 0.;
        }
    }
    return moves;
}

static int
shaped_motion(struct stepper_kinematics *sk, double from, double until, struct axis_motion *out)
{
    while (from < until) {
        int moves = shaped_from(sk, from, out);
        if (out->end < from + SHORTEST_PIECE_S)
            out->end = from + SHORTEST_PIECE_S;
        if (moves) {
            if (out->end > until)
                out->end = until;
            return 1;
        }
        from = out->end;
    }
    return 0;
}

int
itersolve_axis_motion(struct stepper_kinematics *sk, double from, double until, struct axis_motion *out)
{
    return sk->shaped ? shaped_motion(sk, from, until, out) : plain_motion(sk, from, until, out);
}

int
itersolve_set_shaper(struct stepper_kinematics *sk, char axis, int count, const double *weights, const double *delays)
{
    if (axis < 'x' || axis > 'z' || count < 0 || count > SHAPER_PULSES_MAX)
        return -1;
    struct axis_shaper *sh = &sk->shaper[axis - 'x'];
    memset(sh, 0, sizeof(*sh));
    sh->count = sk->axes & (1u << (axis - 'x')) ? count : 0;
    for (int i = 0; i < sh->count; i++) {
        sh->weight[i] = weights[i];
        sh->delay[i] = delays[i];
    }
    double reach = 0.;
    sk->shaped = 0;
    for (int k = 0; k < 3; k++) {
        for (int i = 0; i < sk->shaper[k].count; i++)
            reach = fmax(reach, fabs(sk->shaper[k].delay[i]));
        sk->shaped |= sk->shaper[k].count > 0;
    }
    sk->look_behind = sk->look_ahead = reach;
    if (sk->tq)
        sk->barrier = sk->tq->next;         /* at rest: what was done before is not done again in the new shape */
    return 0;
}

/* ---- linear machines ---- */

static double
mix(const struct stepper_kinematics *sk, double x, double y, double z)
{
    return sk->mix[0] * x + sk->mix[1] * y + sk->mix[2] * z;
}

double
linear_position(const struct stepper_kinematics *sk, const double *xyz)
{
    return mix(sk, xyz[0], xyz[1], xyz[2]) + sk->constant;
}

int
linear_next_piece(struct stepper_kinematics *sk, double from, double until, struct motion_piece *out)
{
    struct axis_motion m;
    while (itersolve_axis_motion(sk, from, until, &m)) {
        out->c[1] = mix(sk, m.c[0][1], m.c[1][1], m.c[2][1]);
        out->c[2] = mix(sk, m.c[0][2], m.c[1][2], m.c[2][2]);
        if (out->c[1] == 0. && out->c[2] == 0.) {
            from = m.end;
            if (!(from < until))
                return 0;
            continue;
        }
        out->start = m.start;
        out->end = m.end;
        out->c[0] = mix(sk, m.c[0][0], m.c[1][0], m.c[2][0]) + sk->constant;
        out->degree = 2;
        return 1;
    }
    return 0;
}

void
itersolve_set_mix(struct stepper_kinematics *sk, double x, double y, double z, double constant)
{
    const double value[3] = { x, y, z };
    sk->axes = 0;
    for (int k = 0; k < 3; k++) {
        sk->mix[k] = value[k];
        sk->axes |= value[k] != 0. ? 1u << k : 0u;
    }
    sk->constant = constant;
}

/* ---- curved machines ---- */

/* A quartic replaces the true course if the cubic through the same ends is this close to it in the middle. The
 * cubic's error is h^4 f''''/384; the quartic, which takes the middle along, is better by a factor of about
 * h f'''''/f'''' / 20: below a hundredth of this, far below what moves a step by a microsecond. */
#define CUBIC_MISS_MM 4e-6
#define PIECE_MIN_S 20e-6
#define PIECE_MAX_S 0.1

struct state {
    double value, slope;
};

static struct state
curved_at(const struct stepper_kinematics *sk, const struct axis_motion *m, double t, double near)
{
    double xyz[3], v[3];
    for (int k = 0; k < 3; k++) {
        xyz[k] = m->c[k][0] + (m->c[k][1] + m->c[k][2] * t) * t;
        v[k] = m->c[k][1] + 2. * m->c[k][2] * t;
    }
    struct state out = { sk->position(sk, xyz), sk->slope(sk, xyz, v) };
    if (sk->period > 0.)
        out.value -= sk->period * round((out.value - near) / sk->period);
    return out;
}

/* Quartic through both ends (value and slope) and the middle (value); h: length */
static void
fit_quartic(const struct state *a, double middle, const struct state *b, double h, double *c)
{
    double rise = b->value - a->value, va = a->slope * h, vb = b->slope * h;
    double miss = middle - (.5 * (a->value + b->value) + .125 * (va - vb));
    double bump = 16. * miss;               /* bump * u^2 (1-u)^2 is `miss` in the middle, flat at the ends */
    double hh = h * h;
    c[0] = a->value;
    c[1] = a->slope;
    c[2] = (3. * rise - 2. * va - vb + bump) / hh;
    c[3] = (va + vb - 2. * rise - 2. * bump) / (hh * h);
    c[4] = bump / (hh * hh);
}

int
curved_next_piece(struct stepper_kinematics *sk, double from, double until, struct motion_piece *out)
{
    struct axis_motion m;
    if (!itersolve_axis_motion(sk, from, until, &m))
        return 0;
    double longest = m.end - m.start, h = sk->piece_s > 0. ? 2. * sk->piece_s : PIECE_MAX_S;
    if (h > PIECE_MAX_S)
        h = PIECE_MAX_S;
    double stands = sk->origin + (double)sk->steps * sk->step_dist;
    double tolerance = sk->period > 0. ? .01 * CUBIC_MISS_MM : CUBIC_MISS_MM;
    struct state a = curved_at(sk, &m, 0., stands);
    for (;;) {
        int whole = h >= longest;
        double length = whole ? longest : h;
        struct state middle = curved_at(sk, &m, .5 * length, a.value);
        struct state b = curved_at(sk, &m, length, middle.value);
        double cubic = .5 * (a.value + b.value) + .125 * length * (a.slope - b.slope);
        if (length <= PIECE_MIN_S || fabs(middle.value - cubic) < tolerance) {
            out->start = m.start;
            out->end = whole ? m.end : m.start + length;
            fit_quartic(&a, middle.value, &b, length, out->c);
            out->degree = 4;
            sk->piece_s = h;
            return 1;
        }
        h = .5 * length;
    }
}
