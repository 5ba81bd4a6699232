/* See plugin_names.h. */
#include "plugin_names.h"

#include <stdlib.h>

/* The pieces that began before end_time and ended after start_time, newest first; returns how many. */
int
trapq_extract_old(const struct trapq *tq, struct pull_move *out, int max, double start_time, double end_time)
{
    int count = 0;
    for (uint64_t number = tq->next; number > tq->first && count < max; number--) {
        const struct segment *s = trapq_segment(tq, number - 1);
        if (s->start_time >= end_time)
            continue;
        if (s->start_time + s->duration <= start_time)
            break;
        out[count++] = (struct pull_move){
            s->start_time, s->duration, s->speed, 2. * s->half_accel,
            s->origin[0], s->origin[1], s->origin[2], s->ratio[0], s->ratio[1], s->ratio[2],
        };
    }
    return count;
}

/* What lies before print_time needs no closing here: every stepper knows how far it has come. */
void
trapq_finalize_moves(struct trapq *tq, double print_time, double clear_history_time)
{
    trapq_forget_before(tq, clear_history_time < print_time ? clear_history_time : print_time);
}

struct trdispatch *
trdispatch_alloc(void)
{
    return calloc(1, sizeof(struct trdispatch));
}

void
trdispatch_start(struct trdispatch *td, uint32_t reason)
{
    (void)reason;
    td->active = 1;
}

void
trdispatch_stop(struct trdispatch *td)
{
    td->active = 0;
}
