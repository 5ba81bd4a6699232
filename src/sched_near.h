/* Near timers: the inner loop of stepping on a processor of 8 bits, with 16 bits of the clocks (PORT_TIMER_NEAR).
 *
 * There is one function of near timers, sched_turn.near.  It stores waketimes less than SCHED_NEAR_TICKS after the last one, so
 * those of all timers that have it differ by less than that as well: each ran when it was the head of the list.  It stays to
 * run them one after the other up to `stop`, the first timer of another function, and never calls shutdown().
 *
 *     now-LATE-NEAR_TICKS    now-LATE    now              now+INTERVAL          now+HORIZON
 *     |<- others ----------->|<- head -->|                | the loop ends       |
 *     |<- all near timers, until the loop ends -------------------------------->| limit, at the latest
 *
 * `now` is the begin of the loop.  That is less than 2^15 ticks from end to end, and so is any of these from the clock then.
 */
#ifndef SCHED_NEAR_H
#define SCHED_NEAR_H

#include "sched.h"

enum {
    SCHED_NEAR_TICKS = 0x2000,
    SCHED_NEAR_LATE = 0x1800,
    NEAR_INTERVAL = 0x1800,  /* 384 us at 16 MHz */
    NEAR_HORIZON = 0x4000,   /* SCHED_NEAR_TICKS after the end of the loop's last event */
};

struct sched_near {
    struct timer *stop;  /* the first timer of another function: there always is that of the house-keeping */
    uint16_t limit;      /* of `stop`, or the horizon if that is nearer */
    uint16_t end;        /* of the loop */
};

static inline uint16_t
sched_near_clock(const struct timer *t)
{
    return (uint16_t)t->waketime;
}

/* The head has run and stored its next waketime: the timers it may go on with.  0 if that waketime is too long ago. */
static inline uint8_t
sched_near_begin(struct sched_near *near, const struct timer *head)
{
    const uint32_t now = timer_read_time();
    if (UNLIKELY(timer_is_before(head->waketime, now - SCHED_NEAR_LATE)))
        return 0;
    struct timer *stop = head->next;
    while (stop->func == head->func)
        stop = stop->next;
    near->stop = stop;
    near->end = (uint16_t)now + NEAR_INTERVAL;
    near->limit = (uint16_t)(timer_is_before(now + NEAR_HORIZON, stop->waketime) ? now + NEAR_HORIZON : stop->waketime);
    return 1;
}

/* For a function that leaves the loop: its timer t is put where its next waketime, which may be any, belongs. */
uint8_t sched_near_leave(struct timer *t);

/* As sched_next_due(), and waits for a timer that comes soon. */
static inline uint8_t
sched_near_next(const struct sched_near *near, struct timer **t, uint16_t clock)
{
    struct timer *head = *t, *next = head->next;
    if (LIKELY(next == near->stop)) {
        if (UNLIKELY((int16_t)(clock - near->limit) >= 0))
            return sched_near_leave(head);
    } else if ((int16_t)(clock - sched_near_clock(next)) >= 0) {
        struct timer *link = next, *after;
        while ((after = link->next) != near->stop && (int16_t)(clock - sched_near_clock(after)) >= 0)
            link = after;
        if (after == near->stop && UNLIKELY((int16_t)(clock - near->limit) >= 0)) {
            sched_near_leave(head);
        } else {
            head->next = after;
            link->next = head;
        }
        *t = head = next;
        clock = sched_near_clock(head);
    }
    uint16_t now = timer_read_low();
    if ((int16_t)(now - clock) < 0) {
        sched_turn.intervals_late = 0;
        if ((uint16_t)(clock - now) > PORT_TIMER_WAIT_TICKS) {
            sched_turn.timers = head;
            return SF_NOTHING_DUE;
        }
        do
            now = timer_read_low();
        while ((int16_t)(now - clock) < 0);
    }
    if (UNLIKELY((int16_t)(now - near->end) >= 0)) {
        sched_turn.timers = head;
        return SF_INTERVAL_OVER;
    }
    return SF_DUE;
}

#endif
