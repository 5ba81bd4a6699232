/* Ringing of a printer's frame: two axes, each a mass on a spring behind its motor.
 *
 *     planned place ──► motor (second order, follows steps) ──► belt: k, c ──► mass with the accelerometer
 *
 *     u" = wm^2 (p - u) - 2 dm wm u'            p: place by steps, u: of the rotor
 *     x" = w^2 (u - x) + 2 d w (u' - x')        x: of the mass
 *
 * The rotor's lag smooths single steps, as a real motor's does. Semi-implicit Euler; a step h makes w faster, so w is
 * 2/h sin(w h/2) there: then the frequency is exact.
 */
#ifndef FERRITE_FRAME_H
#define FERRITE_FRAME_H

enum { FRAME_AXES = 2 };
static const double FRAME_STEP_S = 1.0 / 25600.0;     /* eight to a sample at 3200 Hz */
static const double FRAME_SLOW_STEP_S = 1.0 / 3200.0; /* four to a sample at 800 Hz */

struct frame_axis {
    double frequency_hz, damping_ratio; /* of the mass; 0 Hz: rigid, moves as the rotor */
    double motor_hz;
    double u, u_rate; /* mm, mm/s */
    double x, x_rate;
    double step_s, motor_spring, motor_drag, spring, drag; /* a step, and what it adds to the rates */
};

void frame_axis_init(struct frame_axis *a, double frequency_hz, double damping_ratio, double motor_hz, double place_mm);
/* From now on steps of step_s. */
void frame_axis_set_step(struct frame_axis *a, double step_s);
/* A step with the motor's steps at place_mm. */
void frame_axis_step(struct frame_axis *a, double place_mm);
/* rad/s, as semi-implicit Euler needs it. */
double frame_stepped_w(double frequency_hz, double step_s);

#endif
