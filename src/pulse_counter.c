/* Pulse counters: fan tachometers and the like, by looking at a pin often enough.
 *
 * The pin is read every poll_ticks; every change of level counts (two a pulse).  Every sample_ticks the running count goes
 * to the host with count_clock = the clock of the look that saw the newest change counted, so that a slow fan is measured from
 * edge to edge.  next_clock is when the next sample is due.  poll_ticks = 0 stops it.
 */
#include "basecmd.h"
#include "board/gpio.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"

DECL_RESPONSE(response_counter_state, "counter_state oid=%c next_clock=%u count=%u count_clock=%u");

struct counter_sample {
    uint32_t next_clock, count, count_clock;
};

struct counter {
    struct timer timer;
    struct gpio_in pin;
    uint32_t poll_ticks, sample_ticks, sample_clock;
    uint32_t count, count_clock;
    uint8_t level;
    uint8_t report_due;
    struct counter_sample report;
};

static struct task_wake counter_wake;

void
counter_init(void)
{
    sched_check_wake(&counter_wake);
}
DECL_INIT(counter_init);

/* Timer; every poll_ticks (some 100 us to 1 ms), a dozen cycles.  Late: edges closer than the delay are missed. */
static uint8_t
counter_event(struct timer *t)
{
    struct counter *c = container_of(t, struct counter, timer);
    uint8_t level = gpio_in_read(c->pin);
    if (level != c->level) {
        c->level = level;
        c->count++;
        c->count_clock = t->waketime;
    }
    if (!timer_is_before(t->waketime, c->sample_clock)) {
        c->sample_clock += c->sample_ticks;
        c->report = (struct counter_sample){ c->sample_clock, c->count, c->count_clock };
        c->report_due = 1;
        sched_wake_task(&counter_wake);
    }
    t->waketime += c->poll_ticks;
    return SF_RESCHEDULE;
}

void
command_config_counter(const struct command_args *args)
{
    struct gpio_in pin = gpio_in_setup(args->val[1], (int8_t)args->val[2]);
    struct counter *c = oid_alloc((uint8_t)args->val[0], command_config_counter, sizeof(*c));
    c->pin = pin;
    c->timer.func = counter_event;
}
DECL_COMMAND(command_config_counter, "config_counter oid=%c pin=%u pull_up=%c");

void
command_query_counter(const struct command_args *args)
{
    struct counter *c = oid_lookup((uint8_t)args->val[0], command_config_counter);
    irqstatus_t flag = irq_save();
    sched_del_timer(&c->timer);
    c->timer.waketime = args->val[1];
    c->poll_ticks = args->val[2];
    c->sample_ticks = args->val[3];
    c->sample_clock = args->val[1] + args->val[3];
    c->count = c->report_due = 0;
    c->count_clock = args->val[1];
    c->level = gpio_in_read(c->pin);
    if (c->poll_ticks)
        sched_add_timer(&c->timer);
    irq_restore(flag);
}
DECL_COMMAND(command_query_counter, "query_counter oid=%c clock=%u poll_ticks=%u sample_ticks=%u");

void
counter_task(void)
{
    uint8_t i;
    struct counter *c;
    if (!sched_check_wake(&counter_wake))
        return;
    foreach_oid(i, c, command_config_counter) {
        irqstatus_t flag = irq_save();
        struct counter_sample r = c->report;
        uint8_t due = c->report_due;
        c->report_due = 0;
        irq_restore(flag);
        if (due)
            respond(&response_counter_state, (uint8_t)(i - 1), r.next_clock, r.count, r.count_clock);
    }
}
DECL_TASK(counter_task);
