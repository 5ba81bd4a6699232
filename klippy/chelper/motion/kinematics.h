#ifndef FERRITE_KINEMATICS_H
#define FERRITE_KINEMATICS_H
/* The kinematics of each kind of machine (kin_*.c): a solver for one stepper. Lengths mm, angles rad; NULL: no memory, or
 * no such axis or type. */
#include "itersolve.h"

struct stepper_kinematics *cartesian_stepper_alloc(char axis);
struct stepper_kinematics *corexy_stepper_alloc(char type);
struct stepper_kinematics *corexz_stepper_alloc(char type);
struct stepper_kinematics *generic_cartesian_stepper_alloc(double x, double y, double z);
struct stepper_kinematics *delta_stepper_alloc(double arm2, double tower_x, double tower_y);
struct stepper_kinematics *deltesian_stepper_alloc(double arm2, double arm_x);
struct stepper_kinematics *winch_stepper_alloc(double anchor_x, double anchor_y, double anchor_z);
struct stepper_kinematics *polar_stepper_alloc(char type);
struct stepper_kinematics *rotary_delta_stepper_alloc(double shoulder_radius, double shoulder_height, double angle, double upper_arm, double lower_arm);
struct stepper_kinematics *extruder_stepper_alloc(void);
void extruder_set_pressure_advance(struct stepper_kinematics *sk, double advance_s, double smooth_time_s);

#endif
