#ifndef FERRITE_MOVE_H
#define FERRITE_MOVE_H
/*
 * One straight move: its geometry, and what slows it down or forbids it. klippy/lookahead.py shows it to Python as
 * Move; rows of G-code (gcode_rows.h) make theirs here, too.
 *
 * Units: mm, mm/s, s; names ending in _v2 are squares of speeds.
 */

struct lookahead_move {
    double start_pos[4], end_pos[4], axes_d[4], axes_r[4];
    double move_d, min_move_t, accel, junction_deviation, is_kinematic_move;
    double max_cruise_v2, delta_v2, smooth_delta_v2;
    double max_start_v2, max_smoothed_v2;               /* set when the move is queued */
    double start_v, cruise_v, end_v;                    /* set when it is planned */
    double accel_t, cruise_t, decel_t;
};

/* Doubles only in these: Python packs them in one go. */
struct move_limits {
    double max_velocity, max_accel, junction_deviation, max_accel_to_decel;
};

/* Axes that are not homed have an empty range. */
struct axis_box {
    double min[3], max[3], z_velocity, z_accel;
};

struct filament_limits {
    double can_extrude, nozzle_diameter, max_extrude_ratio, max_e_velocity, max_e_accel, max_e_dist, instant_corner_v;
};

enum filament_problem { FILAMENT_OK, FILAMENT_COLD, FILAMENT_TOO_FAR, FILAMENT_TOO_MUCH };

/* From start to end at `speed`; others_mm is the longest way of further axes. move_d is 0 if nothing moves. */
void move_fill(struct lookahead_move *m, const struct move_limits *limits, const double *start, const double *end,
               double speed, double others_mm);
/* At most this speed and acceleration along the path. */
void move_limit_speed(struct lookahead_move *m, double speed, double accel);
/* Does every axis that moves end inside the box? If so the move is slowed down as z demands. */
int move_check_box(struct lookahead_move *m, const struct axis_box *box);
/* May the filament move so? Slows down moves of the extruder alone. */
enum filament_problem move_check_filament(struct lookahead_move *m, const struct filament_limits *limits);
/* Highest squared speed at the junction: the filament's speed may jump by instant_corner_v. */
double move_filament_v2(const struct lookahead_move *prev, const struct lookahead_move *m, double instant_corner_v);

#endif
