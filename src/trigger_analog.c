/* Stops a homing move when the filtered signal of a sensor passes a threshold; see trigger_analog.h. */
#include "trigger_analog.h"

#include <stddef.h>

#include "basecmd.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"
#include "sos_filter.h"
#include "trsync.h"

enum trigger_type { ABS_GE, GT, DIFF_PEAK_GT, TRIGGER_TYPES };
DECL_ENUMERATION("trigger_analog_type", "abs_ge", ABS_GE);
DECL_ENUMERATION("trigger_analog_type", "gt", GT);
DECL_ENUMERATION("trigger_analog_type", "diff_peak_gt", DIFF_PEAK_GT);

/* Added to error_reason; those of a sensor follow. */
enum trigger_error { RAW_RANGE, OVERFLOW_ERROR, MONITOR, SENSOR_SPECIFIC };
DECL_ENUMERATION("trigger_analog_error:", "RAW_RANGE", RAW_RANGE);
DECL_ENUMERATION("trigger_analog_error:", "OVERFLOW", OVERFLOW_ERROR);
DECL_ENUMERATION("trigger_analog_error:", "MONITOR", MONITOR);
DECL_ENUMERATION("trigger_analog_error:", "SENSOR_SPECIFIC", SENSOR_SPECIFIC);

DECL_RESPONSE(response_trigger_analog_state, "trigger_analog_state oid=%c homing=%c homing_clock=%u");

struct trigger_analog {
    struct timer timer;  /* the monitor */
    struct sos_filter *filter;
    struct trsync *trsync;
    int32_t raw_min, raw_max, trigger_value, peak;
    uint32_t start_clock, homing_clock, monitor_ticks, monitor_max, silent;
    uint8_t type, trigger_reason, error_reason;
    uint8_t homing, has_peak;
};

static uint8_t trigger_analog_type;

struct trigger_analog *
trigger_analog_lookup(uint8_t oid)
{
    return oid_lookup(oid, &trigger_analog_type);
}

/* Interrupts disabled. */
static void
end_homing(struct trigger_analog *t, uint8_t reason)
{
    if (!t->homing)
        return;
    t->homing = 0;
    trsync_do_trigger(t->trsync, reason);
}

static void
end_from_task(struct trigger_analog *t, uint8_t reason)
{
    irqstatus_t flag = irq_save();
    if (t->homing)
        t->homing_clock = timer_read_time();
    end_homing(t, reason);
    sched_del_timer(&t->timer);
    irq_restore(flag);
}

/* Timer, every monitor_ticks (a sample period): a few dozen cycles. */
static uint8_t
monitor_event(struct timer *timer)
{
    struct trigger_analog *t = container_of(timer, struct trigger_analog, timer);
    if (++t->silent > t->monitor_max) {
        t->homing_clock = timer->waketime;
        end_homing(t, t->error_reason + MONITOR);
        return SF_DONE;
    }
    timer->waketime += t->monitor_ticks;
    return SF_RESCHEDULE;
}

static uint8_t
is_passed(struct trigger_analog *t, int32_t value)
{
    switch (t->type) {
    case ABS_GE:
        return value >= t->trigger_value || value <= -t->trigger_value;
    case GT:
        return value > t->trigger_value;
    default:
        if (!t->has_peak || value > t->peak)
            t->peak = value;
        t->has_peak = 1;
        return (int64_t)t->peak - value > t->trigger_value;
    }
}

void
trigger_analog_take(struct trigger_analog *t, int32_t sample)
{
    if (!t || !t->homing)
        return;
    t->silent = 0;
    if (timer_is_before(timer_read_time(), t->start_clock))
        return;
    int32_t value;
    if (sample < t->raw_min || sample > t->raw_max)
        end_from_task(t, t->error_reason + RAW_RANGE);
    else if (!sos_filter_apply(t->filter, sample, &value))
        end_from_task(t, t->error_reason + OVERFLOW_ERROR);
    else if (is_passed(t, value))
        end_from_task(t, t->trigger_reason);
}

void
trigger_analog_fail(struct trigger_analog *t, uint8_t code)
{
    if (t && t->homing)
        end_from_task(t, (uint8_t)(t->error_reason + SENSOR_SPECIFIC + code));
}

/* ---- commands ------------------------------------------------------------------------------ */

void
command_config_trigger_analog(const struct command_args *args)
{
    struct sos_filter *filter = sos_filter_lookup((uint8_t)args->val[1]);
    struct trigger_analog *t = oid_alloc((uint8_t)args->val[0], &trigger_analog_type, sizeof(*t));
    t->filter = filter;
    t->timer.func = monitor_event;
    t->raw_min = INT32_MIN;
    t->raw_max = INT32_MAX;
}
DECL_COMMAND(command_config_trigger_analog, "config_trigger_analog oid=%c sos_filter_oid=%c");

void
command_trigger_analog_set_raw_range(const struct command_args *args)
{
    struct trigger_analog *t = trigger_analog_lookup((uint8_t)args->val[0]);
    t->raw_min = (int32_t)args->val[1];
    t->raw_max = (int32_t)args->val[2];
}
DECL_COMMAND(command_trigger_analog_set_raw_range, "trigger_analog_set_raw_range oid=%c raw_min=%i raw_max=%i");

void
command_trigger_analog_set_trigger(const struct command_args *args)
{
    struct trigger_analog *t = trigger_analog_lookup((uint8_t)args->val[0]);
    if (args->val[1] >= TRIGGER_TYPES)
        shutdown(SHUTDOWN_MODEL_TYPE);
    t->type = (uint8_t)args->val[1];
    t->trigger_value = (int32_t)args->val[2];
}
DECL_COMMAND(command_trigger_analog_set_trigger,
             "trigger_analog_set_trigger oid=%c trigger_analog_type=%c trigger_value=%i");

/* trigger_reason 0: no longer watched. */
void
command_trigger_analog_home(const struct command_args *args)
{
    struct trigger_analog *t = trigger_analog_lookup((uint8_t)args->val[0]);
    irqstatus_t flag = irq_save();
    sched_del_timer(&t->timer);
    t->homing = 0;
    irq_restore(flag);
    if (!args->val[2])
        return;
    sos_filter_reset(t->filter);
    t->trsync = trsync_lookup((uint8_t)args->val[1]);
    t->trigger_reason = (uint8_t)args->val[2];
    t->error_reason = (uint8_t)args->val[3];
    t->start_clock = t->homing_clock = args->val[4];
    t->monitor_ticks = args->val[5];
    t->monitor_max = args->val[6];
    t->silent = t->has_peak = 0;
    flag = irq_save();
    t->homing = 1;
    t->timer.waketime = t->start_clock + t->monitor_ticks;
    if (t->monitor_ticks)
        sched_add_timer(&t->timer);
    irq_restore(flag);
}
DECL_COMMAND(command_trigger_analog_home,
             "trigger_analog_home oid=%c trsync_oid=%c trigger_reason=%c error_reason=%c clock=%u monitor_ticks=%u"
             " monitor_max=%u");

void
command_trigger_analog_query_state(const struct command_args *args)
{
    uint8_t oid = (uint8_t)args->val[0];
    struct trigger_analog *t = trigger_analog_lookup(oid);
    irqstatus_t flag = irq_save();
    uint8_t homing = t->homing;
    uint32_t clock = t->homing_clock;
    irq_restore(flag);
    respond(&response_trigger_analog_state, oid, homing, clock);
}
DECL_COMMAND(command_trigger_analog_query_state, "trigger_analog_query_state oid=%c");

void
trigger_analog_shutdown(void)
{
    uint8_t i;
    struct trigger_analog *t;
    foreach_oid(i, t, &trigger_analog_type)
        t->homing = 0;
}
DECL_SHUTDOWN(trigger_analog_shutdown);
