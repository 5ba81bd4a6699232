/* Queue of planned motion: see trapq.h for the picture. */
#include "trapq.h"

#include <stdlib.h>
#include <string.h>

enum { INITIAL_CAPACITY = 256 };

struct trapq *
trapq_alloc(void)
{
    struct trapq *tq = calloc(1, sizeof(*tq));
    if (!tq)
        return NULL;
    tq->ring = malloc(INITIAL_CAPACITY * sizeof(*tq->ring));
    if (!tq->ring) {
        free(tq);
        return NULL;
    }
    tq->mask = INITIAL_CAPACITY - 1;
    return tq;
}

void
trapq_free(struct trapq *tq)
{
    if (!tq)
        return;
    free(tq->ring);
    free(tq);
}

/* Double the ring; a segment keeps its number, only its place changes. */
static void
grow(struct trapq *tq)
{
    size_t capacity = (tq->mask + 1) * 2;
    struct segment *ring = malloc(capacity * sizeof(*ring));
    if (!ring)
        abort();
    for (uint64_t n = tq->first; n < tq->next; n++)
        ring[n & (capacity - 1)] = *trapq_segment(tq, n);
    free(tq->ring);
    tq->ring = ring;
    tq->mask = capacity - 1;
}

static struct segment *
push(struct trapq *tq)
{
    if (tq->next - tq->first > tq->mask)
        grow(tq);
    return trapq_segment(tq, tq->next++);
}

static double
distance_after(const struct segment *s, double t)
{
    return (s->speed + s->half_accel * t) * t;
}

static double
end_time(const struct segment *s)
{
    return s->start_time + s->duration;
}

/* Add one trapezoid. `accel` is the magnitude used for both ramps; phases of no length are left out. */
void
trapq_append(struct trapq *tq, double print_time,
             double accel_t, double cruise_t, double decel_t,
             double start_pos_x, double start_pos_y, double start_pos_z,
             double axes_r_x, double axes_r_y, double axes_r_z,
             double start_v, double cruise_v, double accel)
{
    const double duration[3] = { accel_t, cruise_t, decel_t };
    const double speed[3] = { start_v, cruise_v, cruise_v };
    const double half_accel[3] = { .5 * accel, 0., -.5 * accel };
    double at[3] = { start_pos_x, start_pos_y, start_pos_z };

    for (int phase = 0; phase < 3; phase++) {
        if (!(duration[phase] > 0.))
            continue;
        struct segment *s = push(tq);
        *s = (struct segment){
            .start_time = print_time, .duration = duration[phase],
            .speed = speed[phase], .half_accel = half_accel[phase],
            .origin = { at[0], at[1], at[2] }, .ratio = { axes_r_x, axes_r_y, axes_r_z },
        };
        double d = distance_after(s, s->duration);
        for (int i = 0; i < 3; i++)
            at[i] += d * s->ratio[i];
        print_time += duration[phase];
    }
}

/* From print_time on the axes rest at x, y, z: later plans are dropped, a running one is cut short. */
void
trapq_set_position(struct trapq *tq, double print_time, double x, double y, double z)
{
    while (tq->next > tq->first && trapq_segment(tq, tq->next - 1)->start_time >= print_time)
        tq->next--;
    if (tq->next > tq->first) {
        struct segment *last = trapq_segment(tq, tq->next - 1);
        if (end_time(last) > print_time)
            last->duration = print_time - last->start_time;
    }
    *push(tq) = (struct segment){ .start_time = print_time, .origin = { x, y, z } };
}

/* Let go of segments that ended before print_time; the newest always stays, it says where we rest. */
void
trapq_forget_before(struct trapq *tq, double print_time)
{
    while (tq->first + 1 < tq->next && end_time(trapq_segment(tq, tq->first)) < print_time)
        tq->first++;
}

/* Number of the last segment that starts at or before print_time; `next` if there is none. */
static uint64_t
find_segment(const struct trapq *tq, double print_time)
{
    uint64_t low = tq->first, high = tq->next;
    while (low < high) {
        uint64_t middle = low + (high - low) / 2;
        if (trapq_segment(tq, middle)->start_time <= print_time)
            low = middle + 1;
        else
            high = middle;
    }
    return low == tq->first ? tq->next : low - 1;
}

/* Copy the segments that touch [start_time, end_time), oldest first; returns how many. */
int
trapq_extract(const struct trapq *tq, struct trapq_span *out, int max, double start, double end)
{
    uint64_t number = find_segment(tq, start);
    int count = 0;
    if (number == tq->next)
        number = tq->first;
    for (; number < tq->next && count < max; number++) {
        const struct segment *s = trapq_segment(tq, number);
        if (s->start_time >= end)
            break;
        if (end_time(s) <= start)
            continue;
        out[count++] = (struct trapq_span){
            s->start_time, s->duration, s->speed, 2. * s->half_accel,
            s->origin[0], s->origin[1], s->origin[2], s->ratio[0], s->ratio[1], s->ratio[2],
        };
    }
    return count;
}

/* Position (3 values, mm) and speed along the path (mm/s) at print_time; 0 if that past is forgotten. */
int
trapq_state_at(const struct trapq *tq, double print_time, double *pos_xyz, double *velocity)
{
    uint64_t number = find_segment(tq, print_time);
    if (number == tq->next)
        return 0;
    const struct segment *s = trapq_segment(tq, number);
    double t = print_time - s->start_time;
    int running = t < s->duration;
    if (!running)
        t = s->duration;
    double d = distance_after(s, t);
    for (int i = 0; i < 3; i++)
        pos_xyz[i] = s->origin[i] + d * s->ratio[i];
    *velocity = running ? s->speed + 2. * s->half_accel * t : 0.;
    return 1;
}
