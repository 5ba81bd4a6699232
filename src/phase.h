/* Bridge phases in time: what the host has asked for ahead (by clock), and what held at which sample.
 * Pure: no board; clocks and sample indices come in as arguments.
 *
 *     host ─► phase_push ─► [pending, by clock] ─► phase_pop_due ─► bridge
 *                                                       └► phase_applied ─► [applied, by sample] ─► phase_run ─► blocks
 *
 * Pending: a list of nodes the caller owns (the firmware's move queue), in order of clock, spanning less than 2^31 ticks.
 * One that comes late is applied at once rather than refused: for a heater the newest word is worth having, and it
 * is the guard that ends a silence.
 * Applied: a ring of steps, a step a bridge period at most (a later one for the same sample takes its place).  With an ADC
 * buffer of up to 64 samples a step that falls out of the ring is older than any sample that can still be read.  With a
 * longer one that needs more than 64 steps within it, none as long as the settling after a step: such samples are
 * mostly discarded, the rest is counted to a later step's phase.
 *
 * Contexts: push and cut in tasks with interrupts disabled; pop, applied in the timer interrupt; run in the ADC's interrupt.
 * The two interrupts must not preempt each other.  All O(1) but phase_run, which walks past steps that have passed, and
 * phase_cut, which walks past the nodes that stay.
 */
#ifndef PHASE_H
#define PHASE_H

#include <stdint.h>

enum { PHASE_RING_LEN = 64 /* power of two */ };

struct phase_node {
    struct phase_node *next;
    uint32_t clock; /* as asked */
    uint32_t due;   /* as possible: not before `earliest` of phase_push */
    uint16_t phase;
};

struct phase_step {
    uint32_t index; /* first sample that sees it */
    uint16_t phase;
};

struct phase_schedule {
    uint16_t phase_max;
    /* pending */
    struct phase_node *first, *last;
    /* applied */
    uint16_t commanded;    /* newest applied phase */
    uint16_t at_sample;    /* phase of the sample phase_run was last asked about */
    uint8_t head, tail;    /* running; steps tail .. head - 1 are in the ring */
    struct phase_step ring[PHASE_RING_LEN];
};

void phase_init(struct phase_schedule *t, uint16_t phase_max);
/* Queue a node with clock and phase filled in.  0 if its clock is before the newest pending one's (the node is not
 * taken), 1 if queued.  Above phase_max becomes phase_max; a clock before `earliest` is due then. */
uint8_t phase_push(struct phase_schedule *t, struct phase_node *node, uint32_t earliest);
/* Take back all pending nodes whose clock is `clock` or later: the first of them, chained by next, or NULL. */
struct phase_node *phase_cut(struct phase_schedule *t, uint32_t clock);
/* The oldest pending node if it is due at `clock`, else NULL. */
struct phase_node *phase_pop_due(struct phase_schedule *t, uint32_t clock);
/* Nothing is pending any more: the caller takes back all nodes at once. */
void phase_forget(struct phase_schedule *t);
/* `phase` was given to the bridge and holds from sample `index` on. */
void phase_applied(struct phase_schedule *t, uint32_t index, uint16_t phase);
/* What holds at sample `index`, and for how many of the next `count` (>= 1) samples. */
uint16_t phase_run(struct phase_schedule *t, uint32_t index, uint16_t count, uint16_t *run);

#endif
