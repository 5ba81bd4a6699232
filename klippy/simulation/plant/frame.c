/* Ringing of the frame; equations in frame.h. */
#include "frame.h"

static const double TWO_PI = 6.283185307179586;
static const double MOTOR_DAMPING = 0.7;

void frame_axis_init(struct frame_axis *a, double frequency_hz, double damping_ratio, double motor_hz, double place_mm)
{
    *a = (struct frame_axis){ .frequency_hz = frequency_hz, .damping_ratio = damping_ratio, .motor_hz = motor_hz,
                              .u = place_mm, .x = place_mm };
}

void frame_axis_step(struct frame_axis *a, double place_mm, double step_s)
{
    double wm = TWO_PI * a->motor_hz, w = TWO_PI * a->frequency_hz;
    a->u_rate += step_s * (wm * wm * (place_mm - a->u) - 2.0 * MOTOR_DAMPING * wm * a->u_rate);
    a->u += step_s * a->u_rate;
    if (w == 0.0) {
        a->x = a->u;
        a->x_rate = a->u_rate;
        return;
    }
    a->x_rate += step_s * (w * w * (a->u - a->x) + 2.0 * a->damping_ratio * w * (a->u_rate - a->x_rate));
    a->x += step_s * a->x_rate;
}
