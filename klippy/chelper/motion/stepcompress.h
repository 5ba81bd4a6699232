#ifndef FERRITE_STEPCOMPRESS_H
#define FERRITE_STEPCOMPRESS_H
/*
 * Step times of one stepper -> queue_step commands.
 *
 * The MCU runs a command (interval I, count n, add A) as steps at
 *
 *     clock(k) = base + k*I + A*k*(k-1)/2        k = 1..n,  base = clock of the step before
 *
 * The wanted clock of each step may be undercut by a tolerance (25 us, or half the distance to the step
 * before if that is less) and never exceeded. With x = (k-1)/2 and both limits divided by k this reads
 *
 *     low(k) <= I + A*x <= high(k)
 *
 * so a command is a straight line stabbing a row of vertical gates, and the best command is the one that
 * stabs as many as possible. The slopes that can pass gates 1..n form an interval that only shrinks with n; the search
 * (fit_command) runs a line until a gate stops it, learns from that gate and the earlier ones which slopes
 * remain, and tries again in the middle, until no whole number is left. It ends at the true optimum in
 * typically two or three runs.
 *
 * Clocks are 64 bit on this side; the MCU sees the low 32.
 */
#include <stddef.h>
#include <stdint.h>

#include "chelper/link/message.h"

struct stepcompress;

struct step_record {                /* what was sent, for position look-ups and reports */
    uint64_t first_clock, last_clock;
    int64_t start_position;         /* steps before this command */
    int32_t step_count;             /* signed: negative runs backwards */
    uint32_t interval;
    int32_t add;
};

struct stepcompress *stepcompress_alloc(uint32_t oid);
void stepcompress_free(struct stepcompress *sc);
/* max_error in clock ticks; tags are the numeric ids of the three commands */
void stepcompress_setup(struct stepcompress *sc, uint32_t max_error, int32_t queue_step_tag,
                        int32_t set_next_step_dir_tag, int32_t reset_step_clock_tag);
void stepcompress_set_invert_dir(struct stepcompress *sc, int invert);
/* clock = (print_time - time_offset) * freq */
void stepcompress_set_time(struct stepcompress *sc, double time_offset, double freq);
/* The MCU dropped its queue and stands at `position` steps since `clock`: forget what is unsent. */
int stepcompress_reset(struct stepcompress *sc, uint64_t clock, int64_t position);
int64_t stepcompress_position_at(const struct stepcompress *sc, uint64_t clock);
int stepcompress_history(const struct stepcompress *sc, struct step_record *out, int max,
                         uint64_t start_clock, uint64_t end_clock);
uint64_t stepcompress_last_clock(const struct stepcompress *sc);
/* ... of those waiting to become commands, too */
double stepcompress_last_known(const struct stepcompress *sc);

/* --- for the step solver --- */
struct step_time_map { double time_offset, freq; };
struct step_time_map stepcompress_time_map(const struct stepcompress *sc);
/* Room for `count` step clocks in direction dir (1 forward), the first at first_clock. *skip is set to the
 * number of steps at the front that are not wanted because they undo a step just made. */
double *stepcompress_reserve(struct stepcompress *sc, int dir, size_t count, double first_clock, size_t *skip);
void stepcompress_commit(struct stepcompress *sc, size_t count);

/* --- for steppersync --- */
/* Turn into messages all steps up to clock (and those a command carries beyond it). */
int stepcompress_flush(struct stepcompress *sc, uint64_t clock);
/* Finished messages, oldest first. Until steppersync hands them on, min_clock carries the clock at which the
 * command's place in the MCU's move queue comes free again and notify_id says whether it needs a place. */
struct queue_message **stepcompress_output(struct stepcompress *sc);
void stepcompress_forget_before(struct stepcompress *sc, uint64_t clock);

enum { STEPCOMPRESS_OK = 0, STEPCOMPRESS_PAST = -1 /* a step before one already sent */ };

#endif
