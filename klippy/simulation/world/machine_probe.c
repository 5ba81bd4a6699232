/* The bed's surface and the probe that looks for it; see machine.h. */
#include "machine.h"

#include <math.h>

/* A BLTouch takes commands as widths of pulses (ANTCLABS: angles of a hobby servo, 10 degrees are 103 us; a width within
 * 40 us of a command's is taken for it). A touch is reported by a pulse, and the pin springs back. */
static const double COMMAND_SLACK_S = 40e-6, TOUCH_PULSE_S = 0.010;
static const double SIGNAL_GAP_S = 0.030; /* after a longer pause between pulses (20 ms) the command is a new one */
static const double DOWN_S = 647e-6, TOUCH_MODE_S = 1163e-6, UP_S = 1472e-6, SELF_TEST_S = 1781e-6, RESET_S = 2194e-6;

int machine_add_probe(struct machine *m, const struct world_probe_options *o, uint32_t seed)
{
    const struct world_pin pins[] = { o->pin, o->control };
    if (m->probe_count == MACHINE_PROBES || o->z_count < 1 || o->z_count > WORLD_PROBE_MOTORS
        || o->x_axis < 0 || o->x_axis >= m->axis_count || o->y_axis < 0 || o->y_axis >= m->axis_count)
        return -1;
    for (int i = 0; i < o->z_count; i++)
        if (o->z_axes[i] < 0 || o->z_axes[i] >= m->axis_count)
            return -1;
    for (int i = 0; i < 2; i++) {
        if (pins[i].mcu < 0)
            continue;
        if (pins[i].mcu >= MACHINE_MCUS || pins[i].pin < 0 || pins[i].pin >= MACHINE_PINS)
            return -1;
        m->pins[pins[i].mcu][pins[i].pin].role = i ? PIN_CONTROL : PIN_PROBE;
        m->pins[pins[i].mcu][pins[i].pin].target = (uint8_t)m->probe_count;
    }
    m->probes[m->probe_count] = (struct probe){ .options = *o, .noise = seed, .pin_out = o->control.mcu < 0 };
    return m->probe_count++;
}

double bed_height_mm(const struct world_bed *b, double x, double y)
{
    double dx = x - b->bump_x_mm, dy = y - b->bump_y_mm, r = b->bump_radius_mm;
    double bump = r > 0.0 ? b->bump_mm * exp(-(dx * dx + dy * dy) / (r * r)) : 0.0;
    return b->height_mm + b->tilt_x * x + b->tilt_y * y + bump;
}

/* Height of the nozzle above the bed at dx, dy from the nozzle. Each Z motor counts by its share of the plane through them
 * all. */
double probe_gap_mm(const struct machine *m, const struct probe *p, double dx_mm, double dy_mm)
{
    const struct world_probe_options *o = &p->options;
    double x = axis_position_mm(&m->axes[o->x_axis]) + dx_mm;
    double y = axis_position_mm(&m->axes[o->y_axis]) + dy_mm;
    double z = 0.0;
    for (int i = 0; i < o->z_count; i++) {
        const double *w = o->z_shares[i];
        z += (w[0] + w[1] * x + w[2] * y) * axis_position_mm(&m->axes[o->z_axes[i]]);
    }
    return z - bed_height_mm(&o->bed, x, y);
}

/* About Gaussian with a standard deviation of 1: the sum of twelve uniform numbers. */
static double draw(uint32_t *state)
{
    double sum = -6.0;
    for (int i = 0; i < 12; i++) {
        *state = *state * 1664525u + 1013904223u;
        sum += *state / 4294967296.0;
    }
    return sum;
}

/* Each approach has an error of its own. */
static int is_touching(const struct machine *m, struct probe *p)
{
    const struct world_probe_options *o = &p->options;
    int touching = probe_gap_mm(m, p, o->x_offset_mm, o->y_offset_mm) <= o->trigger_mm + p->error_mm;
    if (p->touched && !touching)
        p->error_mm = p->options.noise_mm * draw(&p->noise);
    p->touched = touching;
    return touching;
}

uint8_t probe_level(const struct machine *m, struct probe *p, double now_s)
{
    int closed;
    if (p->options.control.mcu < 0) {
        closed = is_touching(m, p);
    } else {
        int touching = p->pin_out && is_touching(m, p);
        if (touching && !p->touch_mode) { /* the touch is reported, and the pin springs back */
            p->pin_out = 0;
            p->pulse_end_s = now_s + TOUCH_PULSE_S;
        }
        closed = p->touch_mode ? touching || !p->pin_out : now_s < p->pulse_end_s;
    }
    return (uint8_t)(closed != (p->options.pin.inverted != 0));
}

static int is_command(double width_s, double command_s)
{
    return fabs(width_s - command_s) < COMMAND_SLACK_S;
}

void probe_control(struct probe *p, uint8_t level, double now_s)
{
    if (level != (p->options.control.inverted != 0)) {
        if (now_s - p->rise_s > SIGNAL_GAP_S)
            p->pulses = 0;
        p->rise_s = now_s;
        return;
    }
    double width_s = now_s - p->rise_s;
    if (is_command(width_s, DOWN_S)) {
        if (p->pulses++ == 0) { /* the same command is repeated as long as the signal lasts: it moves the pin once */
            p->pin_out = !p->options.stuck;
            p->touched = 0;
        }
        p->touch_mode = 0;
    } else {
        p->pulses = 0;
        if (is_command(width_s, UP_S) || is_command(width_s, RESET_S))
            p->pin_out = p->touch_mode = 0;
        else if (is_command(width_s, TOUCH_MODE_S))
            p->touch_mode = 1;
        else if (is_command(width_s, SELF_TEST_S))
            p->touch_mode = 0;
    }
}
