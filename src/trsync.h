/* Trigger synchronisation: many sources (endstops, a time limit, the host) may stop many things (steppers) together.
 *
 *     endstop ─┐                         ┌─► signal: stepper 1 stops
 *     time-out ─┼─► trsync_do_trigger() ─┼─► signal: stepper 2 stops
 *     host    ─┘   (the first wins)      └─► trsync_state to the host
 *
 * Between trsync_start and the trigger, trsync_state is sent every report_ticks, so that the host can prove to the
 * trsyncs of other MCUs (trsync_set_timeout) that this one is alive.
 */
#ifndef TRSYNC_H
#define TRSYNC_H

#include <stdint.h>

struct trsync;

/* Embedded in what is to be stopped; `stop` runs once, interrupts disabled, and the signal is then free for use again. */
struct trsync_signal {
    struct trsync_signal *next;
    void (*stop)(struct trsync_signal *s, uint8_t reason);  /* NULL: not attached */
};

struct trsync *trsync_lookup(uint8_t oid);
/* Task context.  Already attached elsewhere: shuts down.  If the trsync has already triggered, `stop` runs at once. */
void trsync_attach(struct trsync *ts, struct trsync_signal *s, void (*stop)(struct trsync_signal *s, uint8_t reason));
/* Any context, interrupts disabled. */
void trsync_do_trigger(struct trsync *ts, uint8_t reason);

#endif
