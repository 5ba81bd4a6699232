#ifndef FERRITE_LOOKAHEAD_H
#define FERRITE_LOOKAHEAD_H
/*
 * Look-ahead: the row of moves whose speeds are not fixed yet, and the planning of their speeds.
 * klippy/lookahead.py explains the method; this is the calculation.
 *
 * Moves live in one growing ring, addressed by a running number:
 *
 *      first              first + planned                 next
 *        |--- speeds fixed ----|---- may still change ------|
 *
 * Units: mm, mm/s, s; names ending in _v2 are squares of speeds.
 */
#include <stddef.h>
#include <stdint.h>

#include "move.h"

struct trapq;

struct lookahead {
    struct lookahead_move *ring;
    uint64_t first, next;           /* numbers of the oldest and of the next move */
    size_t mask;                    /* capacity - 1; the capacity is a power of two */
    double *entry, *smoothed;       /* room of the planner, capacity + 1 each */
    double review_s, until_review_s;
};

static inline struct lookahead_move *
lookahead_move_at(const struct lookahead *la, uint64_t number)
{
    return &la->ring[number & la->mask];
}

struct lookahead *lookahead_alloc(double review_s);
void lookahead_free(struct lookahead *la);
void lookahead_reset(struct lookahead *la);
/* Queue a move; extruder_v2 is the extruder's own limit for the junction with the move before.
 * Not 0 if it is time to plan. */
int lookahead_add(struct lookahead *la, const struct lookahead_move *move, double extruder_v2);
/* Fix the speeds of moves at the front of the row, all of them unless lazy; returns how many. */
int lookahead_plan(struct lookahead *la, int lazy);
/* Let go of the first `count` moves. */
void lookahead_drop(struct lookahead *la, int count);
/* Hand the first `count` (planned) moves to the motion queues and let go of them. *filament_pos is where the
 * filament is (extruder_tq may be NULL if no move extrudes). Returns the print_time at which they end. */
double lookahead_commit(struct lookahead *la, int count, double print_time, struct trapq *tq,
                        struct trapq *extruder_tq, double *filament_pos);

#endif
