#ifndef FERRITE_KIN_CURVED_H
#define FERRITE_KIN_CURVED_H
/* Solvers of machines with curved stepper positions: see kin_curved.c. Lengths mm, angles rad. */
struct stepper_kinematics *delta_stepper_alloc(double arm2, double tower_x, double tower_y);
struct stepper_kinematics *deltesian_stepper_alloc(double arm2, double arm_x);
struct stepper_kinematics *winch_stepper_alloc(double anchor_x, double anchor_y, double anchor_z);
struct stepper_kinematics *polar_stepper_alloc(char type);
struct stepper_kinematics *rotary_delta_stepper_alloc(double shoulder_radius, double shoulder_height, double angle, double upper_arm, double lower_arm);

#endif
