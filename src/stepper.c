/* Step generation: queues of step segments turned into pin edges at exact clocks.
 *
 * A segment (one queue_step command) is `count` steps: the first `interval` ticks after the step before it, the
 * following at intervals that grow by `add` each.  The nominal clock of every step is kept apart from the wake-up clock
 * of the timer, so a pulse that ends late never shifts the steps after it.
 *
 *   both edges (config_stepper invert_step=-1): every step toggles the pin, one timer event a step
 *
 *     nominal  |     |     |     |
 *     pin      ‾‾‾‾‾‾\_____/‾‾‾‾‾\___
 *
 *   pulses (invert_step 0 or 1): every step is a pulse of step_pulse_ticks at least; the next begins no earlier than
 *   step_pulse_ticks after its end.  Two events a step, but one if the pulse is so short that another interrupt would take
 *   longer (PORT_SHORT_PULSE_TICKS): the step after it is computed meanwhile
 *
 *     nominal  |         |         |
 *     pin      /‾‾\______/‾‾\______/‾‾\___
 *
 * Where PORT_TIMER_NEAR is defined, segments of short intervals are stepped by near_event(), with 16 bits of the clocks.
 *
 * The direction pin changes when a segment is begun: right after the last edge of the segment before it.
 */
#include "stepper.h"

#include "basecmd.h"
#include "board/gpio.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"
#ifdef PORT_TIMER_NEAR
#include "sched_near.h"
#endif
#include "trsync.h"

DECL_CONSTANT("STEPPER_STEP_BOTH_EDGE", 1);
DECL_RESPONSE(response_stepper_position, "stepper_position oid=%c pos=%i");

typedef uint8_t (*step_event)(struct timer *);

struct segment {
    struct move_node node;
    uint32_t interval;
    uint16_t count;
    int16_t add;
    uint8_t dir;
};

struct stepper {
    struct timer timer;           /* its clock is the nominal one with both edges */
    uint32_t interval;            /* from the step to come to the one after */
    uint_fast16_t left;           /* steps of the segment under way still to be made */
    int16_t add;
    struct gpio_out step_pin, dir_pin;
    struct move_queue_head queue;
    struct trsync_signal stop_signal;
    uint32_t step_clock;          /* nominal clock of the next step, or of the last one when idle; see timer */
    uint32_t pulse_ticks;         /* 0: a step on each edge */
    timer_low_t pulse_end;        /* of the last short pulse */
    int32_t position;             /* where the segment under way ends */
    uint8_t active : 1;           /* the timer is running */
    uint8_t pulse_high : 1;       /* in a pulse; the event to come ends it */
    uint8_t idle_level : 1;       /* of the step pin between pulses */
    uint8_t dir : 1;              /* of the segment under way = level of the direction pin */
    uint8_t next_dir : 1;         /* of the next queue_step */
    uint8_t deaf : 1;             /* stopped by a trigger: queue_step is ignored until reset_step_clock */
    uint8_t near : 1;             /* the segment under way is one for near_event() */
};

#ifdef PORT_TIMER_NEAR
static uint8_t near_event(struct timer *t);

/* Longer pulses wait for their end, and the next for its begin, in an event of their own: from pulse to pulse near_event()
 * takes this long without looking at the clock. */
enum { NEAR_PULSE_TICKS = 32 };

/* A segment is begun; its intervals lie between the first and the last. */
static void
note_near(struct stepper *s, const struct segment *m)
{
    const uint32_t last = m->interval + (uint32_t)((int32_t)m->add * (int32_t)(m->count - 1));
    s->near = m->interval < SCHED_NEAR_TICKS && last < SCHED_NEAR_TICKS && s->pulse_ticks <= NEAR_PULSE_TICKS;
}

/* A step has been made: is the next near it? */
static inline void
choose_event(struct stepper *s)
{
    if (s->near)
        s->timer.func = near_event;
}
#else
static inline void
note_near(struct stepper *s, const struct segment *m)
{
    (void)s, (void)m;
}

static inline void
choose_event(struct stepper *s)
{
    (void)s;
}
#endif

/* Begin the next segment; 0 if there is none.  Interrupts disabled. */
static uint8_t
begin_segment(struct stepper *s)
{
    struct segment *m = (struct segment *)move_queue_pop(&s->queue);
    if (!m)
        return 0;
    if (m->dir != s->dir) {
        s->dir = m->dir;
        gpio_out_write(s->dir_pin, s->dir);
    }
    s->step_clock += m->interval;
    s->interval = m->interval + (uint32_t)(int32_t)m->add;
    s->add = m->add;
    s->left = m->count;
    note_near(s, m);
    s->position += s->dir ? (int32_t)m->count : -(int32_t)m->count;
    move_free(m);
    return 1;
}

/* The step at step_clock has been made: on to the next.  0 if the queue is empty, step_clock then stays. */
static uint8_t
next_step(struct stepper *s)
{
    if (--s->left == 0)
        return begin_segment(s);
    s->step_clock += s->interval;
    s->interval += (uint32_t)(int32_t)s->add;
    return 1;
}

static uint8_t
idle(struct stepper *s)
{
    s->active = 0;
    return SF_DONE;
}

/* The last step of a segment has been made: SF_RESCHEDULE if there is another segment. */
static __attribute__((noinline)) uint8_t
segment_ended(struct stepper *s)
{
    s->left = 0;
    s->step_clock = s->timer.waketime;
    if (!begin_segment(s))
        return idle(s);
    s->timer.waketime = s->step_clock;
    return SF_RESCHEDULE;
}

/* Timer, once a step: the inner loop of the machine.  Late: the edge comes late, the nominal clocks stand. */
static uint8_t
both_edges_event(struct timer *t)
{
    const uint32_t end = sched_turn_end();
    uint8_t result;
    do {
        struct stepper *s = container_of(t, struct stepper, timer);
        gpio_out_toggle(s->step_pin);
        uint_fast16_t left = s->left - 1;
        if (UNLIKELY(!left)) {
            if (segment_ended(s) == SF_DONE)
                return SF_DONE;
        } else {
            s->left = left;
            t->waketime += s->interval;
            s->interval += (uint32_t)(int32_t)s->add;
        }
        choose_event(s);
        result = sched_next_due(&t, both_edges_event, end);
    } while (result == SF_DUE);
    return result;
}

/* Timer, twice a step. */
static uint8_t
pulse_event(struct timer *t)
{
    struct stepper *s = container_of(t, struct stepper, timer);
    gpio_out_toggle(s->step_pin);
    s->pulse_high = !s->pulse_high;
    const uint32_t earliest = timer_read_time() + s->pulse_ticks;
    if (s->pulse_high) {
        t->waketime = earliest;
        return SF_RESCHEDULE;
    }
    if (!next_step(s))
        return idle(s);
    t->waketime = timer_is_before(s->step_clock, earliest) ? earliest : s->step_clock;
    return SF_RESCHEDULE;
}

#ifdef PORT_SHORT_PULSE_TICKS
/* Timer, once a step.  What comes next is computed while the pulse lasts, but a next segment is begun after it: it may
 * change the direction, which drivers want to hold for a while after the pulse's first edge. */
static uint8_t
short_pulse_event(struct timer *t)
{
    const uint32_t end = sched_turn_end();
    uint8_t result;
    do {
        struct stepper *s = container_of(t, struct stepper, timer);
        const timer_low_t ticks = (timer_low_t)s->pulse_ticks;
        while ((timer_low_t)(timer_read_low() - s->pulse_end) < ticks)
            ; /* or by chance a round of the low bits later: a wait for nothing, no longer than a pulse */
        gpio_out_toggle(s->step_pin);
        const timer_low_t begun = timer_read_low();
        const uint_fast16_t left = s->left - 1;
        if (LIKELY(left)) {
            s->left = left;
            t->waketime += s->interval;
            s->interval += (uint32_t)(int32_t)s->add;
        }
        while ((timer_low_t)(timer_read_low() - begun) < ticks)
            ;
        gpio_out_toggle(s->step_pin);
        s->pulse_end = timer_read_low();
        if (UNLIKELY(!left) && segment_ended(s) == SF_DONE)
            return SF_DONE;
        choose_event(s);
        result = sched_next_due(&t, short_pulse_event, end);
    } while (result == SF_DUE);
    return result;
}
#else
enum { PORT_SHORT_PULSE_TICKS = 0 };
static uint8_t (*const short_pulse_event)(struct timer *) = pulse_event;
#endif

/* The function of the stepper's timer, whatever its intervals. */
static step_event
own_event(const struct stepper *s)
{
    if (!s->pulse_ticks)
        return both_edges_event;
    return s->pulse_ticks <= PORT_SHORT_PULSE_TICKS ? short_pulse_event : pulse_event;
}

#ifdef PORT_TIMER_NEAR
/* On to the next step of a near segment: 16 bits of the interval, and the carry into the rest of the clock. */
static inline uint16_t
near_advance(struct stepper *s, uint16_t interval)
{
    timer_half_t *clock = (timer_half_t *)&s->timer.waketime;
    const uint16_t sum = clock[0] + interval;
    clock[0] = sum;
    if (sum < interval)
        clock[1]++;
    return sum;
}

static __attribute__((noinline)) uint8_t
near_segment_ended(struct stepper *s)
{
    if (segment_ended(s) == SF_DONE) {
        sched_turn.timers = &s->timer;
        return SF_DONE;
    }
    if (!s->near)
        s->timer.func = own_event(s);
    return sched_near_leave(&s->timer);
}

static inline void
wait_pulse(uint8_t since, uint8_t ticks)
{
    while ((uint8_t)(timer_read_byte() - since) < ticks)
        ;
}

/* One step, and the low bits of the next one's clock; 0 if it was the segment's last.  The interval is stored after the pulse: it
 * is part of the time between two pulses. */
static inline uint8_t
near_step(struct stepper *s, uint16_t *clock)
{
    const uint8_t ticks = (uint8_t)s->pulse_ticks;
    const struct gpio_out pin = s->step_pin;
    gpio_out_toggle(pin);
    const uint8_t begun = timer_read_byte();
    const uint16_t left = s->left - 1;
    if (UNLIKELY(!left)) {
        if (ticks) {
            wait_pulse(begun, ticks);
            gpio_out_toggle(s->step_pin);
        }
        return 0;
    }
    s->left = left;
    const uint16_t interval = *(timer_half_t *)&s->interval;
    *clock = near_advance(s, interval);
    if (LIKELY(ticks)) {
        wait_pulse(begun, ticks);
        gpio_out_toggle(pin);
    }
    *(timer_half_t *)&s->interval = interval + (uint16_t)s->add;
    return 1;
}

/* Timer: steps of either kind, as above, and those that are due after them. */
static uint8_t
near_event(struct timer *t)
{
    struct sched_near near;
    uint16_t clock;
    uint8_t result;
    if (!near_step(container_of(t, struct stepper, timer), &clock))
        return near_segment_ended(container_of(t, struct stepper, timer));
    if (!sched_near_begin(&near, t))
        return sched_near_leave(t);
    while ((result = sched_near_next(&near, &t, clock)) == SF_DUE) {
        if (!near_step(container_of(t, struct stepper, timer), &clock))
            return near_segment_ended(container_of(t, struct stepper, timer));
    }
    return result;
}
#endif

/* Drop everything queued and end a pulse under way.  Interrupts disabled. */
static void
halt(struct stepper *s)
{
    s->position -= s->dir ? (int32_t)s->left : -(int32_t)s->left;
    if (s->pulse_high) {
        s->position += s->dir ? 1 : -1;  /* the step whose pulse this was has been made */
        gpio_out_write(s->step_pin, s->idle_level);
    }
    s->left = 0;
    s->active = s->pulse_high = 0;
}

void
command_config_stepper(const struct command_args *args)
{
    struct stepper *s = oid_alloc((uint8_t)args->val[0], command_config_stepper, sizeof(*s));
    int8_t invert_step = (int8_t)args->val[3];
    s->idle_level = invert_step > 0;
    if (invert_step >= 0)
        s->pulse_ticks = args->val[4] ? args->val[4] : 1;
#ifdef PORT_TIMER_NEAR
    sched_turn.near = near_event;
#endif
    s->step_pin = gpio_out_setup(args->val[1], s->idle_level);
    s->dir_pin = gpio_out_setup(args->val[2], 0);
    move_queue_init(&s->queue);
    move_request_size(sizeof(struct segment));
}
DECL_COMMAND(command_config_stepper,
             "config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c step_pulse_ticks=%u");

struct stepper *
stepper_lookup(uint8_t oid)
{
    return oid_lookup(oid, command_config_stepper);
}

/* Interrupts disabled, first segment just queued. */
static void
start(struct stepper *s)
{
    begin_segment(s);
    if (timer_is_before(s->step_clock, timer_read_time()))
        shutdown(SHUTDOWN_STEPPER_PAST);
    s->active = 1;
    s->timer.func = own_event(s);
    s->timer.waketime = s->step_clock;
    sched_add_timer(&s->timer);
}

void
command_queue_step(const struct command_args *args)
{
    struct stepper *s = stepper_lookup((uint8_t)args->val[0]);
    uint16_t count = (uint16_t)args->val[2];
    if (!count)
        shutdown(SHUTDOWN_STEPPER_COUNT);
    irqstatus_t flag = irq_save();
    if (!s->deaf) {
        struct segment *m = move_alloc();
        m->interval = args->val[1];
        m->count = count;
        m->add = (int16_t)args->val[3];
        m->dir = s->next_dir;
        move_queue_push(&s->queue, &m->node);
        if (!s->active)
            start(s);
    }
    irq_restore(flag);
}
DECL_COMMAND(command_queue_step, "queue_step oid=%c interval=%u count=%hu add=%hi");

void
command_set_next_step_dir(const struct command_args *args)
{
    struct stepper *s = stepper_lookup((uint8_t)args->val[0]);
    s->next_dir = !!args->val[1];
}
DECL_COMMAND(command_set_next_step_dir, "set_next_step_dir oid=%c dir=%c");

void
command_reset_step_clock(const struct command_args *args)
{
    struct stepper *s = stepper_lookup((uint8_t)args->val[0]);
    irqstatus_t flag = irq_save();
    if (s->active)
        shutdown(SHUTDOWN_STEPPER_ACTIVE);
    s->step_clock = args->val[1];
    s->deaf = 0;
    irq_restore(flag);
}
DECL_COMMAND(command_reset_step_clock, "reset_step_clock oid=%c clock=%u");

/* Steps already made: what of the segment under way is left does not count, a pulse that has begun does. */
static int32_t
position_now(const struct stepper *s)
{
    int32_t left = (int32_t)s->left - (s->pulse_high ? 1 : 0);
    return s->dir ? s->position - left : s->position + left;
}

void
command_stepper_get_position(const struct command_args *args)
{
    uint8_t oid = (uint8_t)args->val[0];
    struct stepper *s = stepper_lookup(oid);
    irqstatus_t flag = irq_save();
    int32_t position = position_now(s);
    irq_restore(flag);
    respond(&response_stepper_position, oid, position);
}
DECL_COMMAND_FLAGS(command_stepper_get_position, HF_IN_SHUTDOWN, "stepper_get_position oid=%c");

static void
stop_on_trigger(struct trsync_signal *signal, uint8_t reason)
{
    (void)reason;
    struct stepper *s = container_of(signal, struct stepper, stop_signal);
    sched_del_timer(&s->timer);
    halt(s);
    move_queue_clear(&s->queue);
    s->deaf = 1;
}

void
command_stepper_stop_on_trigger(const struct command_args *args)
{
    struct stepper *s = stepper_lookup((uint8_t)args->val[0]);
    trsync_attach(trsync_lookup((uint8_t)args->val[1]), &s->stop_signal, stop_on_trigger);
}
DECL_COMMAND(command_stepper_stop_on_trigger, "stepper_stop_on_trigger oid=%c trsync_oid=%c");

/* The queue's entries go back to the pool with everybody else's, when the shutdown is cleared. */
void
stepper_shutdown(void)
{
    uint8_t i;
    struct stepper *s;
    foreach_oid(i, s, command_config_stepper) {
        halt(s);
        move_queue_init(&s->queue);
        s->deaf = 1;
    }
}
DECL_SHUTDOWN(stepper_shutdown);
