#ifndef FERRITE_ITERSOLVE_H
#define FERRITE_ITERSOLVE_H
/*
 * Step times of one stepper from the queue of planned motion.
 *
 *   trapq --> next_piece() --> polynomial pieces --> step solver --> stepcompress
 *             (kinematics)     pos(t), degree <= 4
 *
 * A kinematics says where its stepper should be as a polynomial in time, piece by piece. Linear machines
 * (cartesian, and any fixed mix of the axes) give quadratics, solved in closed form; smoothed pressure
 * advance gives quartics, solved by a bracketed Newton iteration. A machine whose positions are no
 * polynomials (curved_next_piece) cuts its motion into pieces short enough for a quartic to fit.
 *
 * Input shaping comes before the kinematics: each axis is a weighted sum of copies of itself shifted in time,
 * so the motion of the axes stays piecewise quadratic (axis_motion), only in more pieces.
 *
 * The stepper stands on a grid: n steps mean origin + n*step_dist. The step n -> n+1 (and back) is due when
 * the wanted position passes the middle between both.
 */
#include <stdint.h>

#include "trapq.h"

struct stepcompress;

enum { PIECE_DEGREE_MAX = 4 };

struct motion_piece {
    double start, end;                      /* print_time (s) */
    double c[PIECE_DEGREE_MAX + 1];         /* position (mm) = sum c[i] * (t - start)^i */
    int degree;
};

/* The axes over a stretch of time: xyz[k] = sum c[k][i] * (t - start)^i */
struct axis_motion {
    double start, end;                      /* print_time (s) */
    double c[3][3];                         /* mm, mm/s, mm/s^2 (halved) */
};

enum { SHAPER_PULSES_MAX = 8 };

/* shaped(t) = sum weight[i] * plain(t - delay[i]); no pulses: not shaped */
struct axis_shaper {
    int count;
    double weight[SHAPER_PULSES_MAX], delay[SHAPER_PULSES_MAX];    /* weights sum to 1; s, ascending */
    uint64_t cursor[SHAPER_PULSES_MAX];     /* trapq segment each copy is in */
};

struct stepper_kinematics {
    /* set by the kinematics */
    int (*next_piece)(struct stepper_kinematics *sk, double from, double until, struct motion_piece *out);
    double (*position)(const struct stepper_kinematics *sk, const double *xyz);
    double look_behind, look_ahead;         /* s of motion around t that pos(t) depends on */
    unsigned int axes;                      /* bit 0 x, 1 y, 2 z: coordinates that move the stepper */
    double mix[3], constant;                /* linear machines: position = mix . xyz + constant */
    /* curved machines: d(position)/dt at xyz moving with velocity v; period of the position (2 pi), 0 if it has none */
    double (*slope)(const struct stepper_kinematics *sk, const double *xyz, const double *v);
    double period;
    double piece_s;                         /* length of the last piece that a quartic fitted */
    struct axis_shaper shaper[3];
    int shaped;                             /* any axis that matters here has pulses */
    /* the stepper */
    struct trapq *tq;
    struct stepcompress *sc;
    uint64_t reader;                        /* trapq segment being worked on */
    uint64_t barrier;                       /* segments before this one are in other coordinates: never looked at */
    double step_dist, origin;               /* mm */
    int64_t steps;                          /* where the stepper will stand after all generated steps */
    double done_time;                       /* steps are generated up to here */
};

/* The next motion of the axes at or after `from`: 1, or 0 if they rest until `until` */
int itersolve_axis_motion(struct stepper_kinematics *sk, double from, double until, struct axis_motion *out);

/* next_piece for machines with position() and slope() */
int curved_next_piece(struct stepper_kinematics *sk, double from, double until, struct motion_piece *out);

/* next_piece and position for position = mix . xyz + constant */
int linear_next_piece(struct stepper_kinematics *sk, double from, double until, struct motion_piece *out);
double linear_position(const struct stepper_kinematics *sk, const double *xyz);

void itersolve_free(struct stepper_kinematics *sk);
void itersolve_set_trapq(struct stepper_kinematics *sk, struct trapq *tq);
void itersolve_set_stepcompress(struct stepper_kinematics *sk, struct stepcompress *sc, double step_dist);
void itersolve_set_position(struct stepper_kinematics *sk, double x, double y, double z);
void itersolve_adopt_steps(struct stepper_kinematics *sk, int64_t steps);
void itersolve_set_steps(struct stepper_kinematics *sk, int64_t steps);
int64_t itersolve_get_steps(const struct stepper_kinematics *sk);
double itersolve_get_origin(const struct stepper_kinematics *sk);
double itersolve_calc_position_from_coord(const struct stepper_kinematics *sk, double x, double y, double z);
int itersolve_is_active_axis(const struct stepper_kinematics *sk, char axis);
/* print_time of the next motion before `until` that is not yet turned into steps; negative if there is none */
double itersolve_check_active(struct stepper_kinematics *sk, double until);
double itersolve_look_ahead(const struct stepper_kinematics *sk);
/* Change how a linear machine's stepper follows the axes; the caller then places it again (set_position). */
void itersolve_set_mix(struct stepper_kinematics *sk, double x, double y, double z, double constant);
/* Shape axis 'x', 'y' or 'z' with `count` pulses (0: not at all); call it at rest. Returns 0, -1 on bad arguments. */
int itersolve_set_shaper(struct stepper_kinematics *sk, char axis, int count, const double *weights, const double *delays);
/* 0, or the stepcompress error that stopped it */
int itersolve_generate_steps(struct stepper_kinematics *sk, double until);

#endif
