/* Theory and contexts: phase.h. */
#include "phase.h"

#include <stddef.h>

static uint8_t
is_before(uint32_t a, uint32_t b)
{
    return (int32_t)(a - b) < 0;
}

void
phase_init(struct phase_schedule *t, uint16_t phase_max)
{
    *t = (struct phase_schedule){.phase_max = phase_max};
}

uint8_t
phase_push(struct phase_schedule *t, struct phase_node *node, uint32_t earliest)
{
    if (t->last && is_before(node->clock, t->last->clock))
        return 0;
    node->due = is_before(node->clock, earliest) ? earliest : node->clock;
    if (node->phase > t->phase_max)
        node->phase = t->phase_max;
    node->next = NULL;
    if (t->last)
        t->last->next = node;
    else
        t->first = node;
    t->last = node;
    return 1;
}

struct phase_node *
phase_cut(struct phase_schedule *t, uint32_t clock)
{
    struct phase_node *kept = NULL, *node = t->first;
    while (node && is_before(node->clock, clock)) {
        kept = node;
        node = node->next;
    }
    if (kept)
        kept->next = NULL;
    else
        t->first = NULL;
    t->last = kept;
    return node;
}

struct phase_node *
phase_pop_due(struct phase_schedule *t, uint32_t clock)
{
    struct phase_node *node = t->first;
    if (!node || is_before(clock, node->due))
        return NULL;
    t->first = node->next;
    if (!t->first)
        t->last = NULL;
    return node;
}

void
phase_forget(struct phase_schedule *t)
{
    t->first = t->last = NULL;
}

static struct phase_step *
ring_at(struct phase_schedule *t, uint8_t place)
{
    return &t->ring[place & (PHASE_RING_LEN - 1)];
}

void
phase_applied(struct phase_schedule *t, uint32_t index, uint16_t phase)
{
    t->commanded = phase;
    struct phase_step *newest = ring_at(t, (uint8_t)(t->head - 1));
    if (t->head != t->tail && !is_before(newest->index, index)) {
        newest->phase = phase;
        return;
    }
    if ((uint8_t)(t->head - t->tail) == PHASE_RING_LEN) {
        t->at_sample = ring_at(t, t->tail)->phase;
        t->tail++;
    }
    *ring_at(t, t->head) = (struct phase_step){.index = index, .phase = phase};
    t->head++;
}

uint16_t
phase_run(struct phase_schedule *t, uint32_t index, uint16_t count, uint16_t *run)
{
    while (t->head != t->tail && !is_before(index, ring_at(t, t->tail)->index)) {
        t->at_sample = ring_at(t, t->tail)->phase;
        t->tail++;
    }
    *run = count;
    if (t->head != t->tail) {
        uint32_t until_step = ring_at(t, t->tail)->index - index;
        if (until_step < count)
            *run = (uint16_t)until_step;
    }
    return t->at_sample;
}
