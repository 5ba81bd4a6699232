/* Ringing of the frame; equations in frame.h. */
#include "frame.h"

#include <math.h>

static const double TWO_PI = 6.283185307179586;
static const double MOTOR_DAMPING = 0.7;

void frame_axis_init(struct frame_axis *a, double frequency_hz, double damping_ratio, double motor_hz, double place_mm)
{
    *a = (struct frame_axis){ .frequency_hz = frequency_hz, .damping_ratio = damping_ratio, .motor_hz = motor_hz,
                              .u = place_mm, .x = place_mm };
}

double frame_stepped_w(double frequency_hz, double step_s)
{
    return 2.0 / step_s * sin(0.5 * TWO_PI * frequency_hz * step_s);
}

void frame_axis_set_step(struct frame_axis *a, double step_s)
{
    double wm = frame_stepped_w(a->motor_hz, step_s), w = frame_stepped_w(a->frequency_hz, step_s);
    a->step_s = step_s;
    a->motor_spring = step_s * wm * wm;
    a->motor_drag = step_s * 2.0 * MOTOR_DAMPING * wm;
    a->spring = step_s * w * w;
    a->drag = step_s * 2.0 * a->damping_ratio * w;
}

void frame_axis_step(struct frame_axis *a, double place_mm)
{
    a->u_rate += a->motor_spring * (place_mm - a->u) - a->motor_drag * a->u_rate;
    a->u += a->step_s * a->u_rate;
    if (a->frequency_hz == 0.0) {
        a->x = a->u;
        a->x_rate = a->u_rate;
        return;
    }
    a->x_rate += a->spring * (a->u - a->x) + a->drag * (a->u_rate - a->x_rate);
    a->x += a->step_s * a->x_rate;
}
