#include "trsync.h"

#include "basecmd.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"

DECL_RESPONSE(response_trsync_state, "trsync_state oid=%c can_trigger=%c trigger_reason=%c clock=%u");

struct trsync {
    struct timer report_timer, expire_timer;
    struct trsync_signal *signals;
    uint32_t report_ticks, report_clock;  /* report_clock: when the pending report fell due, or the trigger */
    uint8_t can_trigger, trigger_reason, expire_reason;
    uint8_t report_due;
};

static struct task_wake trsync_wake;

void
trsync_init(void)
{
    sched_check_wake(&trsync_wake);
}
DECL_INIT(trsync_init);

static void
want_report(struct trsync *ts, uint32_t clock)
{
    ts->report_clock = clock;
    ts->report_due = 1;
    sched_wake_task(&trsync_wake);
}

void
trsync_do_trigger(struct trsync *ts, uint8_t reason)
{
    if (!ts->can_trigger)
        return;
    ts->can_trigger = 0;
    ts->trigger_reason = reason;
    sched_del_timer(&ts->report_timer);
    sched_del_timer(&ts->expire_timer);
    while (ts->signals) {
        struct trsync_signal *s = ts->signals;
        void (*stop)(struct trsync_signal *, uint8_t) = s->stop;
        ts->signals = s->next;
        s->stop = NULL;
        stop(s, reason);
    }
    want_report(ts, timer_read_time());
}

static void
forget_signals(struct trsync *ts)
{
    for (; ts->signals; ts->signals = ts->signals->next)
        ts->signals->stop = NULL;
}

static uint8_t
report_event(struct timer *t)
{
    struct trsync *ts = container_of(t, struct trsync, report_timer);
    want_report(ts, t->waketime);
    t->waketime += ts->report_ticks;
    return SF_RESCHEDULE;
}

static uint8_t
expire_event(struct timer *t)
{
    struct trsync *ts = container_of(t, struct trsync, expire_timer);
    trsync_do_trigger(ts, ts->expire_reason);
    return SF_DONE;
}

void
command_config_trsync(const struct command_args *args)
{
    struct trsync *ts = oid_alloc((uint8_t)args->val[0], command_config_trsync, sizeof(*ts));
    ts->report_timer.func = report_event;
    ts->expire_timer.func = expire_event;
}
DECL_COMMAND(command_config_trsync, "config_trsync oid=%c");

struct trsync *
trsync_lookup(uint8_t oid)
{
    return oid_lookup(oid, command_config_trsync);
}

void
trsync_attach(struct trsync *ts, struct trsync_signal *s, void (*stop)(struct trsync_signal *s, uint8_t reason))
{
    irqstatus_t flag = irq_save();
    if (s->stop)
        shutdown(SHUTDOWN_SIGNAL_ACTIVE);
    if (ts->can_trigger) {
        s->stop = stop;
        s->next = ts->signals;
        ts->signals = s;
    } else {
        stop(s, ts->trigger_reason);
    }
    irq_restore(flag);
}

void
command_trsync_start(const struct command_args *args)
{
    struct trsync *ts = trsync_lookup((uint8_t)args->val[0]);
    irqstatus_t flag = irq_save();
    sched_del_timer(&ts->report_timer);
    sched_del_timer(&ts->expire_timer);
    forget_signals(ts);
    ts->report_timer.waketime = args->val[1];
    ts->report_ticks = args->val[2];
    ts->expire_reason = (uint8_t)args->val[3];
    ts->trigger_reason = 0;
    ts->report_due = 0;
    ts->can_trigger = 1;
    if (ts->report_ticks)
        sched_add_timer(&ts->report_timer);
    irq_restore(flag);
}
DECL_COMMAND(command_trsync_start, "trsync_start oid=%c report_clock=%u report_ticks=%u expire_reason=%c");

void
command_trsync_set_timeout(const struct command_args *args)
{
    struct trsync *ts = trsync_lookup((uint8_t)args->val[0]);
    irqstatus_t flag = irq_save();
    sched_del_timer(&ts->expire_timer);
    ts->expire_timer.waketime = args->val[1];
    /* A message that comes after the time it names is what the time limit is for, and no reason to shut down. */
    if (timer_is_before(args->val[1], timer_read_time()))
        trsync_do_trigger(ts, ts->expire_reason);
    else if (ts->can_trigger)
        sched_add_timer(&ts->expire_timer);
    irq_restore(flag);
}
DECL_COMMAND(command_trsync_set_timeout, "trsync_set_timeout oid=%c clock=%u");

static void
send_state(uint8_t oid, const struct trsync *ts, uint32_t clock)
{
    respond(&response_trsync_state, oid, ts->can_trigger, ts->trigger_reason, clock);
}

/* The host wants an answer also when it comes too late to matter, so this one reports by itself. */
void
command_trsync_trigger(const struct command_args *args)
{
    uint8_t oid = (uint8_t)args->val[0];
    struct trsync *ts = trsync_lookup(oid);
    irqstatus_t flag = irq_save();
    trsync_do_trigger(ts, (uint8_t)args->val[1]);
    ts->report_due = 0;
    irq_restore(flag);
    send_state(oid, ts, ts->report_clock);
}
DECL_COMMAND(command_trsync_trigger, "trsync_trigger oid=%c reason=%c");

void
trsync_task(void)
{
    uint8_t i;
    struct trsync *ts;
    if (!sched_check_wake(&trsync_wake))
        return;
    foreach_oid(i, ts, command_config_trsync) {
        irqstatus_t flag = irq_save();
        struct trsync seen = *ts;
        ts->report_due = 0;
        irq_restore(flag);
        if (seen.report_due)
            send_state((uint8_t)(i - 1), &seen, seen.report_clock);
    }
}
DECL_TASK(trsync_task);

void
trsync_shutdown(void)
{
    uint8_t i;
    struct trsync *ts;
    foreach_oid(i, ts, command_config_trsync) {
        ts->can_trigger = ts->report_due = 0;
        forget_signals(ts);
    }
}
DECL_SHUTDOWN(trsync_shutdown);
