/* Outputs whose value the host schedules ahead: digital pins, hardware PWM.
 *
 * The host queues (clock, value) pairs; one timer carries them out.  If max_duration is not zero, no value other than the
 * default may stand longer than that without being confirmed by a new one: a dead host cannot leave a heater on.
 *
 *     queue:    (c1, v1) (c2, v2) ...
 *     agenda:   the earliest of   next update c1  |  deadline  |  toggle (software PWM)   = the timer's waketime
 *
 * An update further from the one before it than max_duration shuts down when it is due to be looked at ("... will exceed
 * max_duration"); none at all shuts down at the deadline ("Missed scheduling ...").
 */
#ifndef TIMED_OUTPUT_H
#define TIMED_OUTPUT_H

#include <stdint.h>

#include "basecmd.h"
#include "sched.h"

struct timed_output;

/* What differs between kinds of output. */
struct timed_output_kind {
    /* Bring `value` to the pin.  Returns 1 if it is the default value (nothing to guard). */
    uint8_t (*apply)(struct timed_output *o, uint32_t value);
    /* Software PWM: the next edge; o->toggle_clock is when it was due, the function moves it on.  NULL: never toggles. */
    void (*toggle)(struct timed_output *o);
    uint8_t missed_reason, exceed_reason;
};

struct timed_output {
    struct timer timer;
    const struct timed_output_kind *kind;
    struct move_queue_head updates;
    uint32_t max_duration;
    uint32_t deadline;
    uint32_t toggle_clock;
    uint8_t guarded;       /* deadline counts */
    uint8_t toggling;      /* toggle_clock counts; set by apply() */
};

/* In a config command. */
void timed_output_init(struct timed_output *o, const struct timed_output_kind *kind, uint32_t max_duration);
/* Task context: at `clock`, which is after all clocks queued before. */
void timed_output_queue(struct timed_output *o, uint32_t clock, uint32_t value);
/* Task context: now.  The queue must be empty. */
void timed_output_set_now(struct timed_output *o, uint32_t value);
/* Something is queued or toggling. */
uint8_t timed_output_is_busy(const struct timed_output *o);
/* In a DECL_SHUTDOWN function; the owner then drives the pin. */
void timed_output_shutdown(struct timed_output *o);

#endif
