/* Machines whose steppers follow a fixed mix of the axes: core machines and free combinations. */
#include <stdlib.h>

#include "kinematics.h"

struct stepper_kinematics *
generic_cartesian_stepper_alloc(double x, double y, double z)
{
    struct stepper_kinematics *sk = calloc(1, sizeof(*sk));
    if (!sk)
        return NULL;
    sk->next_piece = linear_next_piece;
    sk->position = linear_position;
    itersolve_set_mix(sk, x, y, z, 0.);
    return sk;
}

/* '+': x + y, '-': x - y */
struct stepper_kinematics *
corexy_stepper_alloc(char type)
{
    if (type != '+' && type != '-')
        return NULL;
    return generic_cartesian_stepper_alloc(1., type == '+' ? 1. : -1., 0.);
}

/* '+': x + z, '-': x - z */
struct stepper_kinematics *
corexz_stepper_alloc(char type)
{
    if (type != '+' && type != '-')
        return NULL;
    return generic_cartesian_stepper_alloc(1., 0., type == '+' ? 1. : -1.);
}
