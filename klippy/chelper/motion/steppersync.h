#ifndef FERRITE_STEPPERSYNC_H
#define FERRITE_STEPPERSYNC_H
/*
 * The steppers of one MCU, and its move queue.
 *
 *   itersolve + stepcompress per stepper --merge by clock--> one list of messages for the serialqueue
 *
 * Every queue_step takes a place in the MCU's queue until its last step is made. The queue is a heap of the
 * clocks at which the places come free: a command takes the earliest and may not be sent before it.
 */
#include <stdint.h>

struct stepper_kinematics;
struct stepcompress;
struct steppersync;
struct queue_message;

struct steppersync *steppersync_alloc(int places);
void steppersync_free(struct steppersync *ss);
int steppersync_add_stepper(struct steppersync *ss, struct stepcompress *sc);
/* which solver feeds a stepper (NULL: none, it rests) */
int steppersync_set_kinematics(struct steppersync *ss, int stepper, struct stepper_kinematics *sk);
/* clock = (print_time - time_offset) * freq, for all steppers from now on */
void steppersync_set_time(struct steppersync *ss, double time_offset, double freq);
/* Work out the steps of every stepper up to print_time; 0 or the negative error of stepper *failed. */
int steppersync_generate(struct steppersync *ss, double print_time, int *failed);
/* Clock of the last step worked out, whether sent or not. */
double steppersync_last_clock(const struct steppersync *ss);
/* Messages needed up to clock, in the order they are needed; the caller owns the list.
 * Look-up history older than history_clock is let go. *failed as above, -1 if all is well. */
struct queue_message *steppersync_flush(struct steppersync *ss, uint64_t clock, uint64_t history_clock, int *failed);

#endif
