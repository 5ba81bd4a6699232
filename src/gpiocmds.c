/* Digital outputs: set at once, set at a clock, or modulated in software.
 *
 * Software PWM (set_digital_out_pwm_cycle): an update's value is the on time in ticks.  A cycle begins at the update's own
 * clock, the pin goes on then, off on_ticks later, and so on every cycle_ticks.  0 is off, cycle_ticks or more is on.
 */
#include "basecmd.h"
#include "board/gpio.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"
#include "timed_output.h"

struct digital_out {
    struct timed_output output;
    struct gpio_out pin;
    uint32_t cycle_ticks;       /* 0: plain on and off */
    uint32_t on_ticks, off_ticks;
    uint8_t default_level, level;
};

static void
write_level(struct digital_out *d, uint8_t level)
{
    d->level = level;
    gpio_out_write(d->pin, level);
}

static uint8_t
digital_apply(struct timed_output *o, uint32_t on_ticks)
{
    struct digital_out *d = container_of(o, struct digital_out, output);
    write_level(d, !!on_ticks);
    if (on_ticks && on_ticks < d->cycle_ticks) {
        d->on_ticks = on_ticks;
        d->off_ticks = d->cycle_ticks - on_ticks;
        o->toggle_clock += on_ticks;
        o->toggling = 1;
        return 0;
    }
    return d->level == d->default_level;
}

static void
digital_toggle(struct timed_output *o)
{
    struct digital_out *d = container_of(o, struct digital_out, output);
    write_level(d, !d->level);
    o->toggle_clock += d->level ? d->on_ticks : d->off_ticks;
}

static const struct timed_output_kind digital_kind = {
    .apply = digital_apply,
    .toggle = digital_toggle,
    .missed_reason = SHUTDOWN_DIGITAL_MISSED,
    .exceed_reason = SHUTDOWN_DIGITAL_EXCEED,
};

void
command_config_digital_out(const struct command_args *args)
{
    struct digital_out *d = oid_alloc((uint8_t)args->val[0], command_config_digital_out, sizeof(*d));
    d->default_level = !!args->val[3];
    d->pin = gpio_out_setup(args->val[1], !!args->val[2]);
    timed_output_init(&d->output, &digital_kind, args->val[4]);
    timed_output_set_now(&d->output, !!args->val[2]);
}
DECL_COMMAND(command_config_digital_out,
             "config_digital_out oid=%c pin=%u value=%c default_value=%c max_duration=%u");

static struct digital_out *
digital_lookup(const struct command_args *args)
{
    return oid_lookup((uint8_t)args->val[0], command_config_digital_out);
}

void
command_set_digital_out_pwm_cycle(const struct command_args *args)
{
    struct digital_out *d = digital_lookup(args);
    if (timed_output_is_busy(&d->output))
        shutdown(SHUTDOWN_SOFT_PWM_CYCLE);
    d->cycle_ticks = args->val[1];
}
DECL_COMMAND(command_set_digital_out_pwm_cycle, "set_digital_out_pwm_cycle oid=%c cycle_ticks=%u");

void
command_queue_digital_out(const struct command_args *args)
{
    timed_output_queue(&digital_lookup(args)->output, args->val[1], args->val[2]);
}
DECL_COMMAND(command_queue_digital_out, "queue_digital_out oid=%c clock=%u on_ticks=%u");

void
command_update_digital_out(const struct command_args *args)
{
    struct digital_out *d = digital_lookup(args);
    if (timed_output_is_busy(&d->output))
        shutdown(SHUTDOWN_DIGITAL_QUEUE);
    uint8_t level = !!args->val[1];
    /* With software PWM "on" is a whole cycle, not one tick. */
    timed_output_set_now(&d->output, level && d->cycle_ticks ? d->cycle_ticks : level);
}
DECL_COMMAND(command_update_digital_out, "update_digital_out oid=%c value=%c");

void
command_set_digital_out(const struct command_args *args)
{
    gpio_out_setup(args->val[0], !!args->val[1]);
}
DECL_COMMAND(command_set_digital_out, "set_digital_out pin=%u value=%c");

void
digital_out_shutdown(void)
{
    uint8_t i;
    struct digital_out *d;
    foreach_oid(i, d, command_config_digital_out) {
        timed_output_shutdown(&d->output);
        write_level(d, d->default_level);
    }
}
DECL_SHUTDOWN(digital_out_shutdown);
