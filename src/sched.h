/* Scheduler: timers, tasks, shutdown.
 *
 *   context   runs                       may be interrupted by   must return within
 *   task      commands, DECL_TASK        timers, port's irqs     100 us (500 us delays the host's messages)
 *   timer     struct timer functions     nothing                 a few us; says when it wants to run again
 *   irq       port callbacks (sync_adc)  nothing                 as the callback's header says
 *
 * Timers fire in the order of their clock; same clock, in the order they were added.  Clocks are 32 bit and wrap;
 * comparisons hold for differences below 2^31 ticks (board/timer.h).
 *
 * Shutdown.  shutdown(reason) does not return to its caller, in any context: it jumps (setjmp/longjmp) to the
 * nearest sched_guarded() frame.  Every context has its own frame (each task pass, each timer interrupt, each other
 * interrupt), so the jump never crosses from an interrupt into the code it interrupted, and an interrupt ends
 * by its normal return.  Right there, interrupts disabled, all timers are dropped and the DECL_SHUTDOWN functions
 * put the outputs to their safe state.  If it happened in an interrupt, the interrupted task goes on to its end
 * and the DECL_SHUTDOWN functions run a second time after it, so a half-done command cannot leave an output on.
 * While shut down sched_add_timer() does nothing and only HF_IN_SHUTDOWN commands run.
 */
#ifndef SCHED_H
#define SCHED_H

#include <stddef.h>
#include <stdint.h>

#include "board/timer.h"
#include "shutdown_reasons.h"

/* What a timer function returns.  After SF_DUE it runs the timer sched_next_due() gave, and the last four come from there;
 * SF_DONE then speaks of the timer it gave last. */
enum { SF_DONE, SF_RESCHEDULE, SF_DUE, SF_SORTED, SF_SOON, SF_NOTHING_DUE, SF_INTERVAL_OVER };

/* A timer nearer than this is waited for inside the interrupt, where leaving and coming again costs more. */
#ifndef PORT_TIMER_WAIT_TICKS
#define PORT_TIMER_WAIT_TICKS 0
#endif

struct timer {
    struct timer *next;
    uint8_t (*func)(struct timer *);  /* returns SF_DONE, or SF_RESCHEDULE with a new waketime stored, or what sched_next_due() says */
    uint32_t waketime;
};

#define LIKELY(condition) __builtin_expect(condition, 1)
#define UNLIKELY(condition) __builtin_expect(condition, 0)
#define container_of(ptr, type, member) ((type *)((char *)(ptr) - offsetof(type, member)))

/* The timers, and the end of the interval in which they are run.  For sched.c and the inline functions here. */
extern struct sched_turn {
    struct timer *timers;     /* ascending waketime; while one runs it is the head */
#ifdef PORT_TIMER_NEAR
    uint8_t (*near)(struct timer *);  /* the function of near timers: sched_near.h */
#else
    uint32_t end;
#endif
    uint16_t intervals_late;  /* since a timer was last in time */
} sched_turn;

static inline uint32_t
sched_turn_end(void)
{
#ifdef PORT_TIMER_NEAR
    return 0;
#else
    return sched_turn.end;
#endif
}

/* Into the list from `link` on; behind those of the same clock. */
static inline void
sched_insert(struct timer **link, struct timer *t)
{
    const uint32_t waketime = t->waketime;
    struct timer *next = *link;
    while (next && !timer_is_before(waketime, next->waketime)) {
        link = &next->next;
        next = *link;
    }
    t->next = next;
    *link = t;
}

/* The head of the list has run and wants to again, but another is due before it.  Returns the new head. */
static inline struct timer *
sched_put_back(struct timer *t)
{
    struct timer *head = sched_turn.timers = t->next;
    sched_insert(&head->next, t);
    return head;
}

/* For a function that runs often and has stored the next waketime of its timer t: the timer it is to run next without
 * leaving, which has this function too, and SF_DUE; or else what to return.  `end` is sched_turn_end().  There is always a timer
 * behind: that of the house-keeping. */
static inline uint8_t
sched_next_due(struct timer **t, uint8_t (*func)(struct timer *), uint32_t end)
{
#ifdef PORT_TIMER_NEAR
    (void)t, (void)func, (void)end;
    return SF_RESCHEDULE;
#else
    struct timer *head = *t;
    uint32_t waketime = head->waketime, next_waketime = head->next->waketime;
    if (LIKELY(!timer_is_before(waketime, next_waketime))) {
        *t = head = sched_put_back(head);
        if (UNLIKELY(head->func != func))
            return SF_SORTED;
        waketime = next_waketime;
    }
    uint32_t now = timer_read_time();
    if (UNLIKELY(timer_is_before(now, waketime)))
        return waketime - now > PORT_TIMER_WAIT_TICKS ? SF_NOTHING_DUE : SF_SOON;
    if (UNLIKELY(timer_is_before(end, now)))
        return SF_INTERVAL_OVER;
    return SF_DUE;
#endif
}

/* Any context.  A waketime that has already passed shuts down with "Timer too close".  The timer must not be in the list
 * already (sched_del_timer first); one whose function is running is: it says by its return value what becomes of it, and
 * adding or deleting it there is a mistake or has no effect.  Ignored while shut down. */
void sched_add_timer(struct timer *t);
/* The same, but obeyed also while shut down: house-keeping only, never an output.  A shutdown drops every timer, so
 * the owner adds it again in its DECL_SHUTDOWN function. */
void sched_add_timer_always(struct timer *t);
/* Any context; no effect if the timer is not in the list. */
void sched_del_timer(struct timer *t);

/* A flag from timer or interrupt to task. */
struct task_wake {
    volatile uint8_t wake;
};
void sched_wake_task(struct task_wake *w);       /* any context */
/* Task: was it woken?  Clears it.  One that comes between looking and clearing is for the work that follows anyway. */
static inline uint8_t
sched_check_wake(struct task_wake *w)
{
    if (!w->wake)
        return 0;
    w->wake = 0;
    return 1;
}

_Noreturn void shutdown(enum shutdown_reason reason);
void try_shutdown(enum shutdown_reason reason);  /* as shutdown(), but returns if already shut down */
uint8_t sched_is_shutdown(void);
enum shutdown_reason sched_shutdown_reason(void);
void sched_clear_shutdown(void);
void sched_respond_shutdown(void);               /* report to the host why a command was refused */

/* Who must have come for the watchdog to be fed: the tasks, the timer interrupt, and what is watched besides. */
enum sched_source { SCHED_TIMERS = 1, SCHED_SAMPLES = 2 };
void sched_report(enum sched_source source);     /* interrupts: it has come */
void sched_watch(enum sched_source source, uint8_t on);
uint8_t sched_watchdog_feeds(void);              /* runs round; any context */

/* For ports.  ----------------------------------------------------------------------------------------------- */

void sched_main(void);               /* boot and loop for ever; a port with its own loop uses the next five */
void sched_boot(void);
void sched_run_tasks(void);          /* one pass */
uint32_t sched_last_pass_ticks(void);  /* task: duration of the pass before this one, sleep not counted */
uint8_t sched_tasks_waiting(void);   /* has anything been woken since the last pass began? */
/* Timer interrupt: run what is due, one interval of it at most; returns when to come again, which may be past (at once then, but
 * other interrupts come first). */
uint32_t sched_timer_dispatch(void);
uint32_t sched_next_waketime(void);

/* Run fn(arg) so that shutdown() inside it ends it cleanly.  Wrap every interrupt that calls firmware code
 * (interrupts disabled); timers and tasks are wrapped already. */
void sched_guarded(void (*fn)(void *), void *arg);

#endif
