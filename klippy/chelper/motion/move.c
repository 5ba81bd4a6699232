/* One straight move: see move.h. */
#include "move.h"

#include <math.h>
#include <string.h>

/* Moves without a distance the planner cares about: the acceleration of extruder moves comes from the extruder. */
#define UNLIMITED_ACCEL 99999999.9
/* A motion this short is no motion: far below any step. */
#define MIN_DISTANCE_MM 1e-9
/* Filament per mm of path is the same within this: rounding. */
#define SAME_RATIO 1e-9

void
move_fill(struct lookahead_move *m, const struct move_limits *limits, const double *start, const double *end,
          double speed, double others_mm)
{
    double dx = end[0] - start[0], dy = end[1] - start[1], dz = end[2] - start[2], de = end[3] - start[3], inverse;
    memset(m, 0, sizeof(*m));
    memcpy(m->start_pos, start, sizeof(m->start_pos));
    memcpy(m->end_pos, end, sizeof(m->end_pos));
    m->accel = limits->max_accel;
    m->junction_deviation = limits->junction_deviation;
    m->move_d = sqrt(dx * dx + dy * dy + dz * dz);
    m->is_kinematic_move = m->move_d >= MIN_DISTANCE_MM;
    if (m->is_kinematic_move != 0.) {
        if (speed > limits->max_velocity)
            speed = limits->max_velocity;
        inverse = 1. / m->move_d;
    } else {                                            /* the extruder or further axes alone */
        memcpy(m->end_pos, start, 3 * sizeof(double));
        dx = dy = dz = 0.;
        m->move_d = fmax(fabs(de), others_mm);
        m->accel = UNLIMITED_ACCEL;
        inverse = m->move_d != 0. ? 1. / m->move_d : 0.;
    }
    const double d[4] = { dx, dy, dz, de };
    for (int i = 0; i < 4; i++) {
        m->axes_d[i] = d[i];
        m->axes_r[i] = d[i] * inverse;
    }
    m->min_move_t = m->move_d / speed;
    m->max_cruise_v2 = speed * speed;
    m->delta_v2 = 2. * m->move_d * m->accel;
    m->smooth_delta_v2 = 2. * m->move_d * limits->max_accel_to_decel;
}

void
move_limit_speed(struct lookahead_move *m, double speed, double accel)
{
    double speed2 = speed * speed;
    if (speed2 < m->max_cruise_v2) {
        m->max_cruise_v2 = speed2;
        m->min_move_t = m->move_d / speed;
    }
    if (accel < m->accel)
        m->accel = accel;
    m->delta_v2 = 2. * m->move_d * m->accel;
    if (m->smooth_delta_v2 > m->delta_v2)
        m->smooth_delta_v2 = m->delta_v2;
}

int
move_check_box(struct lookahead_move *m, const struct axis_box *box)
{
    for (int i = 0; i < 3; i++)
        if (m->axes_d[i] != 0. && !(box->min[i] <= m->end_pos[i] && m->end_pos[i] <= box->max[i]))
            return 0;
    if (m->axes_d[2] != 0.) {
        double stretch = m->move_d / fabs(m->axes_d[2]);        /* path length per mm of z */
        move_limit_speed(m, box->z_velocity * stretch, box->z_accel * stretch);
    }
    return 1;
}

enum filament_problem
move_check_filament(struct lookahead_move *m, const struct filament_limits *limits)
{
    double extrude_d = m->axes_d[3], ratio = m->axes_r[3];
    if (limits->can_extrude == 0.)
        return FILAMENT_COLD;
    if ((m->axes_d[0] == 0. && m->axes_d[1] == 0.) || ratio < 0.) {
        if (fabs(extrude_d) > limits->max_e_dist)
            return FILAMENT_TOO_FAR;
        double per_ratio = 1. / fabs(ratio);
        move_limit_speed(m, limits->max_e_velocity * per_ratio, limits->max_e_accel * per_ratio);
        return FILAMENT_OK;
    }
    if (ratio > limits->max_extrude_ratio && extrude_d > limits->nozzle_diameter * limits->max_extrude_ratio)
        return FILAMENT_TOO_MUCH;
    return FILAMENT_OK;
}

double
move_filament_v2(const struct lookahead_move *prev, const struct lookahead_move *m, double instant_corner_v)
{
    double change = m->axes_r[3] - prev->axes_r[3];
    if (-SAME_RATIO < change && change < SAME_RATIO)
        return m->max_cruise_v2;
    double v = instant_corner_v / change;
    return v * v;
}
