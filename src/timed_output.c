#include "timed_output.h"

#include "board/irq.h"
#include "board/timer.h"

struct update {
    struct move_node node;
    uint32_t clock, value;
};

static struct update *
front(const struct timed_output *o)
{
    return (struct update *)o->updates.first;
}

/* Carry out the first queued update, due now. */
static void
take_update(struct timed_output *o)
{
    struct update *u = (struct update *)move_queue_pop(&o->updates);
    uint32_t clock = u->clock, value = u->value;
    move_free(u);
    o->toggle_clock = clock;
    o->toggling = 0;
    uint8_t is_default = o->kind->apply(o, value);
    o->guarded = o->max_duration && !is_default;
    o->deadline = clock + o->max_duration;
    struct update *next = front(o);
    if (o->guarded && next && timer_is_before(o->deadline, next->clock))
        shutdown((enum shutdown_reason)o->kind->exceed_reason);
}

/* The earliest thing on the agenda into the timer; SF_DONE if there is none. */
static uint8_t
set_waketime(struct timed_output *o)
{
    uint8_t wanted = SF_DONE;
    uint32_t clock = 0;
    if (front(o)) {
        clock = front(o)->clock;
        wanted = SF_RESCHEDULE;
    } else if (o->guarded) {
        clock = o->deadline;
        wanted = SF_RESCHEDULE;
    }
    if (o->toggling && (wanted == SF_DONE || timer_is_before(o->toggle_clock, clock))) {
        clock = o->toggle_clock;
        wanted = SF_RESCHEDULE;
    }
    o->timer.waketime = clock;
    return wanted;
}

/* Timer.  Once an update, twice a cycle with software PWM (10 ms and more); about a hundred cycles. */
static uint8_t
output_event(struct timer *t)
{
    struct timed_output *o = container_of(t, struct timed_output, timer);
    uint32_t due = t->waketime;
    struct update *next = front(o);
    if (next && next->clock == due)
        take_update(o);
    else if (o->guarded && o->deadline == due) /* nothing is queued, or it would have exceeded max_duration */
        shutdown((enum shutdown_reason)o->kind->missed_reason);
    else
        o->kind->toggle(o);
    return set_waketime(o);
}

void
timed_output_init(struct timed_output *o, const struct timed_output_kind *kind, uint32_t max_duration)
{
    o->kind = kind;
    o->max_duration = max_duration;
    o->timer.func = output_event;
    move_queue_init(&o->updates);
    move_request_size(sizeof(struct update));
}

void
timed_output_queue(struct timed_output *o, uint32_t clock, uint32_t value)
{
    struct update *u = move_alloc();
    u->clock = clock;
    u->value = value;
    irqstatus_t flag = irq_save();
    uint8_t was_empty = move_queue_empty(&o->updates);
    move_queue_push(&o->updates, &u->node);
    if (was_empty) {
        if (o->guarded && timer_is_before(o->deadline, clock))
            shutdown((enum shutdown_reason)o->kind->exceed_reason);
        /* A toggle that comes before the update is in the timer list already, and may be due this very moment: taking it
         * out and putting it back would find it in the past. */
        if (!o->toggling || timer_is_before(clock, o->toggle_clock)) {
            sched_del_timer(&o->timer);
            set_waketime(o);
            sched_add_timer(&o->timer);
        }
    }
    irq_restore(flag);
}

void
timed_output_set_now(struct timed_output *o, uint32_t value)
{
    irqstatus_t flag = irq_save();
    uint32_t now = timer_read_time();
    sched_del_timer(&o->timer);
    o->toggle_clock = now;
    o->toggling = 0;
    uint8_t is_default = o->kind->apply(o, value);
    o->guarded = o->max_duration && !is_default;
    o->deadline = now + o->max_duration;
    if (set_waketime(o) == SF_RESCHEDULE)
        sched_add_timer(&o->timer);
    irq_restore(flag);
}

uint8_t
timed_output_is_busy(const struct timed_output *o)
{
    return o->toggling || !move_queue_empty(&o->updates);
}

void
timed_output_shutdown(struct timed_output *o)
{
    move_queue_init(&o->updates);
    o->guarded = o->toggling = 0;
}
