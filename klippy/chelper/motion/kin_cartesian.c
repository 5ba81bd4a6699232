/* Cartesian machines: one stepper, one axis. */
#include <stdlib.h>

#include "kinematics.h"

struct stepper_kinematics *
cartesian_stepper_alloc(char axis)
{
    if (axis < 'x' || axis > 'z')
        return NULL;
    struct stepper_kinematics *sk = calloc(1, sizeof(*sk));
    if (!sk)
        return NULL;
    sk->next_piece = linear_next_piece;
    sk->position = linear_position;
    sk->mix[axis - 'x'] = 1.;
    sk->axes = 1u << (axis - 'x');
    return sk;
}
