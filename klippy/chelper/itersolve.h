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
 * polynomials cuts its motion into pieces short enough for one to fit.
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

struct stepper_kinematics {
    /* set by the kinematics */
    int (*next_piece)(struct stepper_kinematics *sk, double from, double until, struct motion_piece *out);
    double (*position)(const struct stepper_kinematics *sk, const double *xyz);
    double look_behind, look_ahead;         /* s of motion around t that pos(t) depends on */
    unsigned int axes;                      /* bit 0 x, 1 y, 2 z: coordinates that move the stepper */
    double mix[3];                          /* linear machines: position = mix . xyz */
    /* the stepper */
    struct trapq *tq;
    struct stepcompress *sc;
    uint64_t reader;                        /* trapq segment being worked on */
    double step_dist, origin;               /* mm */
    int64_t steps;                          /* where the stepper will stand after all generated steps */
    double done_time;                       /* steps are generated up to here */
};

/* next_piece and position for position = mix . xyz */
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
/* 0, or the stepcompress error that stopped it */
int itersolve_generate_steps(struct stepper_kinematics *sk, double until);

#endif
