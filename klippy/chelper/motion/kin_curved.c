/*
 * Machines whose stepper positions are curves of the axes. Each gives its position as a function of x, y, z and the
 * rate at which it changes when the head moves with a velocity v; itersolve fits polynomials to the two.
 *
 *   delta          carriage height on a tower: an arm of fixed length between carriage and head
 *   deltesian      the same in the x-z plane
 *   winch          length of a cable to an anchor
 *   polar          radius of the arm, angle of the bed
 *   rotary delta   angle of the upper arm at a shoulder
 */
#include <math.h>
#include <stdlib.h>

#include "kinematics.h"

/* Nearer to the centre of a polar machine the bed's angle has no meaning: treated as standing still (mm^2). */
#define POLAR_CENTRE_MM2 1e-12

struct geometry {
    double p[6];                        /* each kinematics names its entries below */
};

struct curved {
    struct stepper_kinematics sk;       /* first: the two are one object */
    struct geometry geometry;
};

static struct stepper_kinematics *
new_curved(double (*position)(const struct stepper_kinematics *, const double *),
           double (*slope)(const struct stepper_kinematics *, const double *, const double *), unsigned int axes,
           double period, struct geometry geometry)
{
    struct curved *k = calloc(1, sizeof(*k));
    if (!k)
        return NULL;
    k->sk.next_piece = curved_next_piece;
    k->sk.position = position;
    k->sk.slope = slope;
    k->sk.axes = axes;
    k->sk.period = period;
    k->geometry = geometry;
    return (struct stepper_kinematics *)k;      /* not &k->sk, which gcc's analyzer takes for a leak of k */
}

static const double *
geometry(const struct stepper_kinematics *sk)
{
    return ((const struct curved *)sk)->geometry.p;
}

/* ---- delta: p = arm^2, tower x, tower y ---- */

static double
delta_height(const double *p, const double *xyz)
{
    double dx = xyz[0] - p[1], dy = xyz[1] - p[2];
    return sqrt(fmax(p[0] - dx * dx - dy * dy, 0.));
}

static double
delta_position(const struct stepper_kinematics *sk, const double *xyz)
{
    return xyz[2] + delta_height(geometry(sk), xyz);
}

static double
delta_slope(const struct stepper_kinematics *sk, const double *xyz, const double *v)
{
    const double *p = geometry(sk);
    double height = delta_height(p, xyz);
    if (!(height > 0.))
        return v[2];
    return v[2] - ((xyz[0] - p[1]) * v[0] + (xyz[1] - p[2]) * v[1]) / height;
}

struct stepper_kinematics *
delta_stepper_alloc(double arm2, double tower_x, double tower_y)
{
    return new_curved(delta_position, delta_slope, 7u, 0., (struct geometry){{ arm2, tower_x, tower_y }});
}

/* ---- deltesian: p = arm^2, foot x ---- */

static double
deltesian_position(const struct stepper_kinematics *sk, const double *xyz)
{
    const double *p = geometry(sk);
    double dx = xyz[0] - p[1];
    return xyz[2] + sqrt(fmax(p[0] - dx * dx, 0.));
}

static double
deltesian_slope(const struct stepper_kinematics *sk, const double *xyz, const double *v)
{
    const double *p = geometry(sk);
    double dx = xyz[0] - p[1], height = sqrt(fmax(p[0] - dx * dx, 0.));
    return height > 0. ? v[2] - dx * v[0] / height : v[2];
}

struct stepper_kinematics *
deltesian_stepper_alloc(double arm2, double arm_x)
{
    return new_curved(deltesian_position, deltesian_slope, 5u, 0., (struct geometry){{ arm2, arm_x }});
}

/* ---- winch: p = anchor x, y, z ---- */

static double
winch_position(const struct stepper_kinematics *sk, const double *xyz)
{
    const double *p = geometry(sk);
    double dx = xyz[0] - p[0], dy = xyz[1] - p[1], dz = xyz[2] - p[2];
    return sqrt(dx * dx + dy * dy + dz * dz);
}

static double
winch_slope(const struct stepper_kinematics *sk, const double *xyz, const double *v)
{
    const double *p = geometry(sk);
    double length = winch_position(sk, xyz);
    if (!(length > 0.))
        return 0.;
    return ((xyz[0] - p[0]) * v[0] + (xyz[1] - p[1]) * v[1] + (xyz[2] - p[2]) * v[2]) / length;
}

struct stepper_kinematics *
winch_stepper_alloc(double anchor_x, double anchor_y, double anchor_z)
{
    return new_curved(winch_position, winch_slope, 7u, 0., (struct geometry){{ anchor_x, anchor_y, anchor_z }});
}

/* ---- polar ---- */

static double
radius_position(const struct stepper_kinematics *sk, const double *xyz)
{
    (void)sk;
    return hypot(xyz[0], xyz[1]);
}

static double
radius_slope(const struct stepper_kinematics *sk, const double *xyz, const double *v)
{
    double r = radius_position(sk, xyz);
    return r > 0. ? (xyz[0] * v[0] + xyz[1] * v[1]) / r : 0.;
}

static double
angle_position(const struct stepper_kinematics *sk, const double *xyz)
{
    (void)sk;
    return atan2(xyz[1], xyz[0]);
}

static double
angle_slope(const struct stepper_kinematics *sk, const double *xyz, const double *v)
{
    (void)sk;
    double r2 = xyz[0] * xyz[0] + xyz[1] * xyz[1];
    return r2 > POLAR_CENTRE_MM2 ? (xyz[0] * v[1] - xyz[1] * v[0]) / r2 : 0.;
}

/* 'r': radius (mm), 'a': angle (rad) */
struct stepper_kinematics *
polar_stepper_alloc(char type)
{
    if (type == 'r')
        return new_curved(radius_position, radius_slope, 3u, 0., (struct geometry){{ 0. }});
    if (type == 'a')
        return new_curved(angle_position, angle_slope, 3u, 2. * M_PI, (struct geometry){{ 0. }});
    return NULL;
}

/* ---- rotary delta: p = shoulder radius, shoulder height, cos and sin of its direction, upper arm, lower arm^2 ---- */

/* The head seen from the shoulder: outward from the machine's axis, sideways, up. */
static void
from_shoulder(const double *p, const double *xyz, double *out)
{
    out[0] = p[2] * xyz[0] + p[3] * xyz[1] - p[0];
    out[1] = p[2] * xyz[1] - p[3] * xyz[0];
    out[2] = xyz[2] - p[1];
}

/* The lower arm of fixed length joins the elbow U*(cos a, sin a) to the head (outward d, up h, sideways s):
 * d cos a + h sin a = (d^2 + h^2 + s^2 + U^2 - L^2) / 2U. The elbow is the one turned outward. */
static double
rotary_delta_position(const struct stepper_kinematics *sk, const double *xyz)
{
    const double *p = geometry(sk);
    double d[3];
    from_shoulder(p, xyz, d);
    double reach2 = d[0] * d[0] + d[2] * d[2];
    double ratio = (reach2 + d[1] * d[1] + p[4] * p[4] - p[5]) / (2. * p[4] * sqrt(reach2));
    return atan2(d[2], d[0]) + acos(fmin(fmax(ratio, -1.), 1.));
}

static double
rotary_delta_slope(const struct stepper_kinematics *sk, const double *xyz, const double *v)
{
    const double *p = geometry(sk);
    double d[3], a = rotary_delta_position(sk, xyz);
    from_shoulder(p, xyz, d);
    double c = cos(a), s = sin(a);
    double out = d[0] - p[4] * c, up = d[2] - p[4] * s;     /* the lower arm */
    double rate = out * (p[2] * v[0] + p[3] * v[1]) + d[1] * (p[2] * v[1] - p[3] * v[0]) + up * v[2];
    double lever = p[4] * (up * c - out * s);
    return lever != 0. ? rate / lever : 0.;
}

struct stepper_kinematics *
rotary_delta_stepper_alloc(double shoulder_radius, double shoulder_height, double angle, double upper_arm,
                           double lower_arm)
{
    struct geometry p = {
        { shoulder_radius, shoulder_height, cos(angle), sin(angle), upper_arm, lower_arm * lower_arm },
    };
    return new_curved(rotary_delta_position, rotary_delta_slope, 7u, 2. * M_PI, p);
}
