#include <setjmp.h>

#include "board/irq.h"
#include "board/timer.h"
#include "board/watchdog.h"
#include "command.h"
#include "sched.h"

#ifdef DICTIONARY_PASS
#define X(name, text) DICT_ENTRY_SERIES("static_string_id", text, name)
SHUTDOWN_REASONS(X)
#undef X
#endif

DECL_RESPONSE(response_starting, "starting");
DECL_RESPONSE(response_shutdown, "shutdown clock=%u static_string_id=%hu");
DECL_RESPONSE(response_is_shutdown, "is_shutdown static_string_id=%hu");

/* A timer that asks to run again at once, for ever, would hang the machine; so many in one interrupt is a mistake.
 * Origin: above any honest burst (a few timers per stepper), below a second of hanging on the slowest machine. */
enum { DISPATCH_LIMIT = 20000 };
/* How late a timer may ask to be run again before the machine is called overloaded. */
enum { RESCHEDULE_LATE_US = 100000 };

struct recovery {
    jmp_buf frame;
};

static struct {
    struct timer *timers;             /* ascending waketime */
    struct recovery *recovery;        /* the innermost sched_guarded() */
    uint32_t shutdown_clock;
    uint32_t pass_ticks;              /* how long the last pass of the tasks took */
    uint8_t reason;                   /* of the shutdown now in force or being entered; SHUTDOWN_NONE: running */
    uint8_t outputs_again;            /* a shutdown came in an interrupt: run DECL_SHUTDOWN again after the task */
    uint8_t announce_shutdown, announce_start;
    volatile uint8_t tasks_waiting;
} sched;

static struct task_wake announce_wake;

static void
power_on_state(void)
{
    sched.timers = NULL;
    sched.recovery = NULL;
    sched.shutdown_clock = 0;
    sched.pass_ticks = 0;
    sched.reason = SHUTDOWN_NONE;
    sched.outputs_again = 0;
    sched.announce_shutdown = 0;
    sched.announce_start = 1;
    sched.tasks_waiting = 0;
    sched_wake_task(&announce_wake);
}

/****************************************************************
 * Timers
 ****************************************************************/

static void
timer_insert(struct timer *t)
{
    struct timer **link = &sched.timers;
    while (*link && !timer_is_before(t->waketime, (*link)->waketime))
        link = &(*link)->next;
    t->next = *link;
    *link = t;
}

void
sched_add_timer_always(struct timer *t)
{
    irqstatus_t flag = irq_save();
    if (timer_is_before(t->waketime, timer_read_time()))
        shutdown(SHUTDOWN_TIMER_TOO_CLOSE);
    timer_insert(t);
    if (sched.timers == t)
        timer_kick();
    irq_restore(flag);
}

void
sched_add_timer(struct timer *t)
{
    if (!sched.reason)
        sched_add_timer_always(t);
}

void
sched_del_timer(struct timer *t)
{
    irqstatus_t flag = irq_save();
    for (struct timer **link = &sched.timers; *link; link = &(*link)->next) {
        if (*link != t)
            continue;
        *link = t->next;
        break;
    }
    irq_restore(flag);
}

uint32_t
sched_next_waketime(void)
{
    /* Empty only between a shutdown and the next house-keeping timer; look again soon. */
    return sched.timers ? sched.timers->waketime : timer_read_time() + timer_from_us(1000);
}

static void
run_due_timers(void *unused)
{
    (void)unused;
    uint16_t budget = DISPATCH_LIMIT;
    for (;;) {
        struct timer *t = sched.timers;
        uint32_t now = timer_read_time();
        if (!t || timer_is_before(now, t->waketime))
            return;
        sched.timers = t->next;
        if (t->func(t) == SF_DONE)
            continue;
        if (!--budget || timer_is_before(t->waketime, now - timer_from_us(RESCHEDULE_LATE_US)))
            shutdown(SHUTDOWN_RESCHEDULED_IN_PAST);
        timer_insert(t);
    }
}

uint32_t
sched_timer_dispatch(void)
{
    sched_guarded(run_due_timers, NULL);
    return sched_next_waketime();
}

/****************************************************************
 * Tasks
 ****************************************************************/

void
sched_wake_task(struct task_wake *w)
{
    w->wake = 1;
    sched.tasks_waiting = 1;
}

uint8_t
sched_check_wake(struct task_wake *w)
{
    irqstatus_t flag = irq_save();
    uint8_t woken = w->wake;
    w->wake = 0;
    irq_restore(flag);
    return woken;
}

uint8_t
sched_tasks_waiting(void)
{
    return sched.tasks_waiting;
}

static void
task_pass(void *unused)
{
    (void)unused;
    compile_time_tasks();
}

void
sched_run_tasks(void)
{
    uint32_t start = timer_read_time();
    sched.tasks_waiting = 0;
    sched_guarded(task_pass, NULL);
    sched.pass_ticks = timer_read_time() - start;
    watchdog_feed();
}

uint32_t
sched_last_pass_ticks(void)
{
    return sched.pass_ticks;
}

/* Announcements are made here, in a task, because shutdowns come from anywhere. */
void
sched_announce_task(void)
{
    if (!sched_check_wake(&announce_wake))
        return;
    if (sched.announce_start) {
        sched.announce_start = 0;
        respond(&response_starting);
    }
    if (sched.announce_shutdown) {
        sched.announce_shutdown = 0;
        respond(&response_shutdown, sched.shutdown_clock, sched.reason);
    }
}
DECL_TASK(sched_announce_task);

static void
init_functions(void *unused)
{
    (void)unused;
    compile_time_init();
}

void
sched_boot(void)
{
    power_on_state();
    sched_guarded(init_functions, NULL);
    watchdog_start();
}

void
sched_main(void)
{
    sched_boot();
    irq_enable();
    for (;;) {
        sched_run_tasks();
        irq_disable();
        if (!sched.tasks_waiting)
            irq_wait();
        irq_enable();
    }
}

/****************************************************************
 * Shutdown
 ****************************************************************/

uint8_t
sched_is_shutdown(void)
{
    return sched.reason != SHUTDOWN_NONE;
}

enum shutdown_reason
sched_shutdown_reason(void)
{
    return (enum shutdown_reason)sched.reason;
}

/* Interrupts disabled.  Timers are forgotten, not called; their owners' DECL_SHUTDOWN functions know. */
static void
make_safe(void)
{
    sched.timers = NULL;
    compile_time_shutdown();
}

static void
enter_shutdown(void)
{
    make_safe();
    sched.announce_shutdown = 1;
    sched_wake_task(&announce_wake);
    timer_kick();
}

void
sched_guarded(void (*fn)(void *), void *arg)
{
    struct recovery here;
    struct recovery *const outer = sched.recovery;
    const irqstatus_t flag = irq_save();
    irq_restore(flag);
    sched.recovery = &here;
    if (!setjmp(here.frame)) {
        fn(arg);
    } else {
        irq_disable();
        enter_shutdown();
        sched.outputs_again = outer != NULL;
    }
    sched.recovery = outer;
    if (sched.outputs_again && !outer) {
        irq_disable();
        sched.outputs_again = 0;
        make_safe();
    }
    irq_restore(flag);
}

_Noreturn void
shutdown(enum shutdown_reason reason)
{
    irq_disable();
    if (!sched.reason) {  /* the first reason is the one worth knowing */
        sched.reason = (uint8_t)reason;
        sched.shutdown_clock = timer_read_time();
    }
    longjmp(sched.recovery->frame, 1);
}

void
try_shutdown(enum shutdown_reason reason)
{
    if (!sched.reason)
        shutdown(reason);
}

void
sched_clear_shutdown(void)
{
    if (!sched.reason)
        shutdown(SHUTDOWN_NOT_SHUTDOWN);
    sched.reason = SHUTDOWN_NONE;
}

void
sched_respond_shutdown(void)
{
    respond(&response_is_shutdown, sched.reason);
}
