#include "board/irq.h"
#include "board/timer.h"
#include "board/watchdog.h"
#include "command.h"
#include "sched.h"
#ifdef PORT_TIMER_NEAR
#include "sched_near.h"
#endif

#ifdef DICTIONARY_PASS
#define X(name, text) DICT_ENTRY_SERIES("static_string_id", text, name)
SHUTDOWN_REASONS(X)
#undef X
#endif

DECL_RESPONSE(response_starting, "starting");
DECL_RESPONSE(response_shutdown, "shutdown clock=%u static_string_id=%hu");
DECL_RESPONSE(response_is_shutdown, "is_shutdown static_string_id=%hu");

enum {
    /* So many timer events in one interrupt, then others get their turn.  Origin: some 50 us of steps on a 72 MHz chip. */
    INTERVAL_EVENTS = 64,
    /* So many intervals without ever being in time: a timer asks to run again at once, for ever.  Origin: above any honest
     * burst (a few timers per stepper), below a second of hanging on the slowest machine. */
    INTERVALS_MAX = 300,
    PAUSE_INTERVALS = 16,  /* after so many without leaving the interrupt, tasks get PORT_TIMER_PAUSE_TICKS */
    LATE_MAX_US = 100000,  /* a timer that runs later than this: the machine is overloaded */
};
/* So long in one interrupt, then others get their turn. */
#ifdef PORT_TIMER_INTERVAL_TICKS
enum { INTERVAL_TICKS = PORT_TIMER_INTERVAL_TICKS };
#else
enum { INTERVAL_TICKS = PORT_CLOCK_HZ / 1000000u * 96 };
#endif

/* Time for the tasks when timers leave them none (after PAUSE_INTERVALS); steps are late by that much then. */
#ifdef PORT_TIMER_PAUSE_TICKS
enum { PAUSE_TICKS = PORT_TIMER_PAUSE_TICKS };
#else
enum { PAUSE_TICKS = 0 };
#endif



/* What __builtin_setjmp keeps: frame, place, stack.  Registers are saved and loaded by the function that lands. */
struct recovery {
    void *frame[5];
};

static struct {
    struct recovery *recovery;        /* the innermost sched_guarded() */
    uint32_t shutdown_clock;
    uint32_t pass_ticks;              /* how long the last pass of the tasks took */
    uint8_t reason;                   /* of the shutdown now in force or being entered; SHUTDOWN_NONE: running */
    uint8_t outputs_again;            /* a shutdown came in an interrupt: run DECL_SHUTDOWN again after the task */
    uint8_t announce_shutdown, announce_start;
    volatile uint8_t alive;           /* enum sched_source: which have come since the watchdog was fed */
    uint8_t watched;                  /* which must have */
    uint8_t feeds;
    uint8_t dispatching;              /* the head of the list is the timer that runs now */
    uint8_t intervals_busy;           /* since tasks have last had a turn */
    volatile uint8_t tasks_waiting;
} sched;
struct sched_turn sched_turn;

static struct task_wake announce_wake;

static void
power_on_state(void)
{
    sched_turn.timers = NULL;
#ifndef PORT_TIMER_NEAR
    sched_turn.end = 0;
#endif
    sched_turn.intervals_late = 0;
    sched.recovery = NULL;
    sched.shutdown_clock = 0;
    sched.pass_ticks = 0;
    sched.reason = SHUTDOWN_NONE;
    sched.outputs_again = 0;
    sched.announce_shutdown = 0;
    sched.announce_start = 1;
    sched.alive = 0;
    sched.watched = SCHED_TIMERS;
    sched.feeds = 0;
    sched.dispatching = 0;
    sched.intervals_busy = 0;
    sched.tasks_waiting = 0;
    sched_wake_task(&announce_wake);
}

/****************************************************************
 * Timers
 ****************************************************************/

void
sched_add_timer_always(struct timer *t)
{
    irqstatus_t flag = irq_save();
    if (timer_is_before(t->waketime, timer_read_time()))
        shutdown(SHUTDOWN_TIMER_TOO_CLOSE);
    sched_insert(sched.dispatching ? &sched_turn.timers->next : &sched_turn.timers, t);
    if (sched_turn.timers == t)
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
    for (struct timer **link = sched.dispatching ? &sched_turn.timers->next : &sched_turn.timers; *link; link = &(*link)->next) {
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
    return sched_turn.timers ? sched_turn.timers->waketime : timer_read_time() + timer_from_us(1000);
}

static inline uint8_t
still_first(const struct timer *t)
{
    const struct timer *next = t->next;
    return !next || timer_is_before(t->waketime, next->waketime);
}

#ifdef PORT_TIMER_NEAR
uint8_t
sched_near_leave(struct timer *t)
{
    sched_turn.timers = t;
    if (!still_first(t))
        t = sched_put_back(t);
    if (timer_is_before(t->waketime, timer_read_time() + PORT_TIMER_WAIT_TICKS))
        return SF_SORTED;
    sched_turn.intervals_late = 0;
    return SF_NOTHING_DUE;
}
#endif

/* Nothing is due: is it worth waiting for? */
static uint8_t
comes_soon(uint32_t late)
{
    if (!(late >> 31))
        shutdown(SHUTDOWN_RESCHEDULED_IN_PAST);
    sched_turn.intervals_late = 0;
    if (-late <= PORT_TIMER_WAIT_TICKS)
        return 1;
    sched.intervals_busy = 0;
    return 0;
}

/* The hot path of all stepping, optimised for a timer that stays the head of the list: it stays there while it runs. */
static void
run_due_timers(void *unused)
{
    (void)unused;
    uint_fast8_t left = INTERVAL_EVENTS;
    struct timer *t = sched_turn.timers;
#ifndef PORT_TIMER_NEAR
    sched_turn.end = timer_read_time() + INTERVAL_TICKS;
#endif
    while (t) {
        uint32_t late = timer_read_time() - t->waketime;
        if (UNLIKELY(late > timer_from_us(LATE_MAX_US))) {
            if (comes_soon(late))
                continue;
            return;
        }
        uint8_t result = t->func(t);
        if (result == SF_DONE) {
            t = sched_turn.timers = sched_turn.timers->next;
        } else if (LIKELY(result < SF_SORTED)) {
            if (!still_first(t))
                t = sched_put_back(t);
        } else {
            if (result == SF_INTERVAL_OVER)
                break;
            t = sched_turn.timers;
            if (result != SF_SORTED)
                sched_turn.intervals_late = 0;
            if (result == SF_NOTHING_DUE) {
                sched.intervals_busy = 0;
                return;
            }
        }
        if (!--left)
            break;
    }
    sched.intervals_busy++;
    if (++sched_turn.intervals_late > INTERVALS_MAX)
        shutdown(SHUTDOWN_RESCHEDULED_IN_PAST);
}

#ifdef PORT_TIMER_NEAR
/* The steps, most of the time.  Their function never shuts down, so it needs no guard; 1 if nothing else is due. */
static inline uint8_t
run_near(void)
{
    struct timer *t = sched_turn.timers;
    if (!t || t->func != sched_turn.near || timer_read_time() - t->waketime > SCHED_NEAR_LATE)
        return 0;
    const uint8_t result = t->func(t);
    if (result == SF_DONE)
        sched_turn.timers = sched_turn.timers->next;
    return result == SF_NOTHING_DUE;
}
#endif

/* Timers take all the time there is: give the tasks a turn, or no message of the host is ever handled. */
static __attribute__((noinline)) uint32_t
after_pause(void)
{
    uint32_t next = sched_next_waketime(), end = timer_read_time() + PAUSE_TICKS;
    sched.intervals_busy = 0;
    return timer_is_before(next, end) ? end : next;
}

uint32_t
sched_timer_dispatch(void)
{
    sched_report(SCHED_TIMERS);
#ifdef PORT_TIMER_NEAR
    if (run_near())
        return sched_turn.timers->waketime;
#endif
    sched.dispatching = sched_turn.timers != NULL;
    sched_guarded(run_due_timers, NULL);
    sched.dispatching = 0;
    return sched.intervals_busy < PAUSE_INTERVALS ? sched_next_waketime() : after_pause();
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
sched_report(enum sched_source source)
{
    sched.alive |= source;
}

void
sched_watch(enum sched_source source, uint8_t on)
{
    irqstatus_t flag = irq_save();
    sched.watched = on ? sched.watched | source : sched.watched & (uint8_t)~source;
    irq_restore(flag);
}

uint8_t
sched_watchdog_feeds(void)
{
    return sched.feeds;
}

/* The watchdog is fed for tasks and all watched interrupts being alive: limits of time (heaters, a silent host) live in timers,
 * those of the signal in the interrupt of the samples. */
void
sched_run_tasks(void)
{
    uint32_t start = timer_read_time();
    sched.tasks_waiting = 0;
    sched_guarded(task_pass, NULL);
    sched.pass_ticks = timer_read_time() - start;
    if (sched.watched & (uint8_t)~sched.alive)
        return;
    sched.alive = 0;
    sched.feeds++;
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
        while (!sched.tasks_waiting) /* at the latest basecmd.c's house-keeping timer ends this */
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
    sched_turn.timers = NULL;
    sched.dispatching = 0;
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
    if (!__builtin_setjmp(here.frame)) {
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

/* Never inlined: a function may not jump to its own landing place. */
__attribute__((noinline)) _Noreturn void
shutdown(enum shutdown_reason reason)
{
    irq_disable();
    if (!sched.reason) {  /* the first reason is the one worth knowing */
        sched.reason = (uint8_t)reason;
        sched.shutdown_clock = timer_read_time();
    }
    __builtin_longjmp(sched.recovery->frame, 1);
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
