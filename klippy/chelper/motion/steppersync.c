/* The steppers of one MCU and its move queue: see steppersync.h. */
#include "steppersync.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "itersolve.h"
#include "stepcompress.h"

struct member {
    struct stepcompress *sc;
    struct stepper_kinematics *sk;
};

struct steppersync {
    struct member *members;
    int member_count;
    uint64_t *free_clock;           /* binary heap, earliest at the root */
    int places;
};

struct steppersync *
steppersync_alloc(int places)
{
    struct steppersync *ss = calloc(1, sizeof(*ss));
    if (!ss)
        return NULL;
    ss->places = places > 0 ? places : 1;
    ss->free_clock = calloc((size_t)ss->places, sizeof(*ss->free_clock));
    if (!ss->free_clock) {
        free(ss);
        return NULL;
    }
    return ss;
}

void
steppersync_free(struct steppersync *ss)
{
    if (!ss)
        return;
    free(ss->members);
    free(ss->free_clock);
    free(ss);
}

int
steppersync_add_stepper(struct steppersync *ss, struct stepcompress *sc)
{
    struct member *members = realloc(ss->members, (size_t)(ss->member_count + 1) * sizeof(*members));
    if (!members)
        return -1;
    ss->members = members;
    members[ss->member_count] = (struct member){ sc, NULL };
    return ss->member_count++;
}

int
steppersync_set_kinematics(struct steppersync *ss, int stepper, struct stepper_kinematics *sk)
{
    if (stepper < 0 || stepper >= ss->member_count)
        return -1;
    ss->members[stepper].sk = sk;
    return 0;
}

void
steppersync_set_time(struct steppersync *ss, double time_offset, double freq)
{
    for (int i = 0; i < ss->member_count; i++)
        stepcompress_set_time(ss->members[i].sc, time_offset, freq);
}

int
steppersync_generate(struct steppersync *ss, double print_time, int *failed)
{
    for (int i = 0; i < ss->member_count; i++) {
        if (!ss->members[i].sk)
            continue;
        int ret = itersolve_generate_steps(ss->members[i].sk, print_time);
        if (ret) {
            *failed = i;
            return ret;
        }
    }
    return 0;
}

double
steppersync_last_clock(const struct steppersync *ss)
{
    double last = 0.;
    for (int i = 0; i < ss->member_count; i++)
        last = fmax(last, stepcompress_last_known(ss->members[i].sc));
    return last;
}

/* Occupy the place that comes free first until `clock`; returns since when it is free. */
static uint64_t
take_place(struct steppersync *ss, uint64_t clock)
{
    uint64_t *heap = ss->free_clock, earliest = heap[0];
    int at = 0;
    for (int child = 1; child < ss->places; child = 2 * at + 1) {
        if (child + 1 < ss->places && heap[child + 1] < heap[child])
            child++;
        if (heap[child] >= clock)
            break;
        heap[at] = heap[child];
        at = child;
    }
    heap[at] = clock;
    return earliest;
}

/* The member whose next message is needed first, if by `clock`. */
static struct queue_message **
first_due(struct steppersync *ss, uint64_t clock)
{
    struct queue_message **best = NULL;
    for (int i = 0; i < ss->member_count; i++) {
        struct queue_message **out = stepcompress_output(ss->members[i].sc);
        if (*out && (*out)->req_clock <= clock && (!best || (*out)->req_clock < (*best)->req_clock))
            best = out;
    }
    return best;
}

struct queue_message *
steppersync_flush(struct steppersync *ss, uint64_t clock, uint64_t history_clock, int *failed)
{
    struct queue_message *list = NULL, **tail = &list, **urgent;
    *failed = -1;
    for (int i = 0; i < ss->member_count; i++) {
        if (stepcompress_flush(ss->members[i].sc, clock))
            *failed = i;
        stepcompress_forget_before(ss->members[i].sc, history_clock);
    }
    while ((urgent = first_due(ss, clock))) {
        struct queue_message *m = *urgent;
        *urgent = m->next;
        if (m->notify_id)
            m->min_clock = take_place(ss, m->min_clock);
        m->notify_id = 0;
        m->next = NULL;
        *tail = m;
        tail = &m->next;
    }
    return list;
}
