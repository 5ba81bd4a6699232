/* A heater switched by the MCU itself: on below a set point, off above it, and metered (HydraRaptor 2007).
 *
 * The host computes which reading the target has and says it once a second; here every value of the analog input
 * (adccmds.c) is compared with it.  For heaters so slow, and hosts or lines so busy, that this is enough.
 *
 *     value ── in low..high? ── compare with set_point ── pin          on_ticks = time the pin has been on, in total
 *
 * Between two reports the mean power is full power times the share of on_ticks in clock: no PWM, nothing estimated.
 *
 * Off without the host: no set_onoff for max_duration while enabled shuts down.  So does an input that has stopped reporting
 * values.  A value outside low..high turns the pin off at once (the input's own range check shuts down after a few).
 */
#include "analog_in.h"
#include "basecmd.h"
#include "board/gpio.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"

DECL_RESPONSE(response_onoff_state, "onoff_state oid=%c clock=%u on_ticks=%u value=%hu on=%c");

struct onoff {
    struct timer timer; /* at the deadline, while enabled */
    struct analog_listener listener;
    struct gpio_out pin;
    uint32_t max_duration;
    uint32_t clock, on_ticks; /* of the newest value; total on time until then */
    uint16_t set_point, low, high, value;
    uint8_t enabled, rising, invert;
    uint8_t on, report_ready;
};

static struct task_wake onoff_wake;

static void
write_pin(struct onoff *o, uint8_t on)
{
    o->on = on;
    gpio_out_write(o->pin, on ^ o->invert);
}

/* Account for the time since the last value; now is the new last. */
static void
account(struct onoff *o, uint32_t now)
{
    if (o->on)
        o->on_ticks += now - o->clock;
    o->clock = now;
}

/* Timer context, once a value; a few dozen cycles. */
static void
onoff_value(struct analog_listener *l, uint16_t value)
{
    struct onoff *o = container_of(l, struct onoff, listener);
    account(o, timer_read_time());
    uint8_t cold = o->rising ? value < o->set_point : value > o->set_point;
    write_pin(o, o->enabled && cold && value >= o->low && value <= o->high);
    o->value = value;
    o->report_ready = 1;
    sched_wake_task(&onoff_wake);
}

/* Timer: the host has not spoken for max_duration. */
static uint8_t
onoff_deadline(struct timer *t)
{
    struct onoff *o = container_of(t, struct onoff, timer);
    write_pin(o, 0);
    shutdown(SHUTDOWN_ONOFF_TIMEOUT);
    return SF_DONE;
}

void
command_config_onoff(const struct command_args *args)
{
    struct onoff *o = oid_alloc((uint8_t)args->val[0], command_config_onoff, sizeof(*o));
    o->invert = !!args->val[3];
    o->pin = gpio_out_setup(args->val[1], o->invert);
    o->max_duration = args->val[4];
    o->timer.func = onoff_deadline;
    o->listener.on_value = onoff_value;
    analog_in_listen((uint8_t)args->val[2], &o->listener);
}
DECL_COMMAND(command_config_onoff, "config_onoff oid=%c pin=%u analog_oid=%c invert=%c max_duration=%u");

/* enable=0: off.  rising: the reading rises with the temperature. */
void
command_set_onoff(const struct command_args *args)
{
    struct onoff *o = oid_lookup((uint8_t)args->val[0], command_config_onoff);
    irqstatus_t flag = irq_save();
    uint32_t now = timer_read_time();
    sched_del_timer(&o->timer);
    uint8_t was_enabled = o->enabled;
    o->enabled = !!args->val[1];
    o->set_point = (uint16_t)args->val[2];
    o->rising = !!args->val[3];
    o->low = (uint16_t)args->val[4];
    o->high = (uint16_t)args->val[5];
    if (!o->enabled && o->on) {
        account(o, now);
        write_pin(o, 0);
    }
    if (o->enabled) {
        if (was_enabled && now - o->clock > o->max_duration)
            shutdown(SHUTDOWN_ONOFF_SILENT);
        o->timer.waketime = now + o->max_duration;
        sched_add_timer(&o->timer);
    }
    irq_restore(flag);
}
DECL_COMMAND(command_set_onoff, "set_onoff oid=%c enable=%c set_point=%hu rising=%c low=%hu high=%hu");

void
onoff_task(void)
{
    uint8_t i;
    struct onoff *o;
    if (!sched_check_wake(&onoff_wake))
        return;
    foreach_oid(i, o, command_config_onoff) {
        irqstatus_t flag = irq_save();
        uint8_t ready = o->report_ready, on = o->on;
        uint32_t clock = o->clock, on_ticks = o->on_ticks;
        uint16_t value = o->value;
        o->report_ready = 0;
        irq_restore(flag);
        if (ready)
            respond(&response_onoff_state, (uint8_t)(i - 1), clock, on_ticks, value, on);
    }
}
DECL_TASK(onoff_task);

void
onoff_shutdown(void)
{
    uint8_t i;
    struct onoff *o;
    foreach_oid(i, o, command_config_onoff) {
        o->enabled = 0;
        o->report_ready = 0;
        write_pin(o, 0);
    }
}
DECL_SHUTDOWN(onoff_shutdown);
