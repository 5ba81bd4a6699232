/* Tests of the chain from bridge to ADC while the nozzle is heated: the firmware does something to the signal, and the
 * signal must answer as a sound chain does.  They need no host, no temperature and hardly any heat.
 * Pure: no board; sample indices and samples come in as arguments, "trip now" comes out.
 *
 *     move   sampling instant moved by some ticks        ....aaaa|MMMM|aaaa....     M - mean of a: within limits
 *     off    bridge off                                  ........|------oooo|~~~~~~~~....   o: within limits
 *            a, M, o: SIGNAL_TEST_LEN samples each   -: the current dies out   ~: settling   |...|: skipped
 *
 * move.  The signal is the phase of the coil current at the sampling instant, so it moves by gain * 360 deg * frequency *
 * delay, whatever nozzle, temperature and drive.  A signal that is frozen, also one with noise, stands still; one
 * with a wrong gain or a stuck bit moves too little or too far.  The samples on both sides remove a slope; a sine of
 * amplitude a and frequency f is left with a * (2 pi f * 16 periods)^2 / 2, 9 % of it at 500 Hz and 120 kHz.
 * How far it moves on this board is learned: the first SIGNAL_TEST_LEARN moves, one right after the other, need only
 * lie within the limits.  All later ones must also be as far as their mean, to tolerance/256 of it and slack.
 * off.  Without current the signal is that of no current.  A bridge that conducts all the same shows a nozzle.
 * While it is driven with SIGNAL_TEST_OFF_PHASE or more this is not asked: a bridge that conducts all the time does no more
 * harm than what is wanted, and the climb needs all of its samples.
 * idle.  A block without drive must show no current, too.  SIGNAL_IDLE_BLOCKS in a row that do not trip.  Only the first of
 * them can hold the end of a current that dies out.  No heat and no test is needed for it.
 * jump.  Between blocks whose phases differ by less than 1/32 the mean moves by no more than a fixed limit,
 * plus what a nozzle can rise or fall in the time between them.  The limit grows with the phase, to 5.4 times at full drive:
 * there a cold nozzle's signal follows the ripple of the supply by 5.8 units a percent.  2 V at 100 or 120 Hz on 24 V move
 * three blocks in a row by 54 units at full drive, by 13 at two thirds of the phase.
 *
 * Tests of the two kinds alternate, `interval` samples from one to the next.  After a bad one the next comes at once: the
 * second bad one of a kind in a row trips; a bad move is followed by another move, so that a frozen signal is not taken for
 * a bridge that conducts.  Bad jumps trip after SIGNAL_JUMP_BLOCKS in a row.  A rule whose upper limit is 0 is off.
 *
 * The owner plans a test (signal_test_plan), begins it with the bridge or the ADC at the planned sample, ends it
 * signal_test_length() samples later, and says for which sample each was done.  Samples in between, and until the
 * instant or the current is what it was, are no temperature: signal_test_run() says which to skip.  A step of the drive cancels a test.
 *
 * Formats: moved, slack, jump, rise, fall in 1/16 LSB; a sum of 16 samples is a mean in 1/16 LSB.  Indices run modulo 2^32.
 * Contexts: plan, run, feed, block in the ADC's interrupt; begin, end, cancel in the timer interrupt.  The two must not
 * preempt each other.  Costs 40 cycles a block, and 10 for each of the 48 samples of a test.
 */
#ifndef SIGNAL_TEST_H
#define SIGNAL_TEST_H

#include <stdint.h>

#include "guard.h"

enum {
    SIGNAL_TEST_LEN = 16,
    SIGNAL_TEST_EDGE = 2,     /* a step of the instant takes effect that late after the sample it was meant for, at the latest */
    SIGNAL_TEST_OFF_LEN = 48, /* 32 for 40 A to fall below 0.02 A: 7.6 time constants of 27 us are 25 samples at 120 kHz */
    SIGNAL_TEST_LEARN_SHIFT = 2,
    SIGNAL_TEST_LEARN = 1 << SIGNAL_TEST_LEARN_SHIFT,
    SIGNAL_TEST_OFF_PHASE = 22500, /* half the voltage's duty */
    SIGNAL_TEST_BAD = 2,      /* in a row trip */
    SIGNAL_JUMP_BLOCKS = 3,   /* in a row trip */
    SIGNAL_IDLE_BLOCKS = 4,   /* in a row trip */
};

enum signal_test_kind { SIGNAL_TEST_NONE, SIGNAL_TEST_MOVE, SIGNAL_TEST_OFF };

struct signal_test_limits {
    uint16_t moved_low, moved_high; /* 1/16 LSB */
    uint16_t slack;                 /* 1/16 LSB */
    uint8_t tolerance;              /* 1/256 */
    uint16_t off_low, off_high;     /* LSB */
    uint16_t interval;              /* samples */
    uint16_t phase;                 /* below it nothing is tested */
    uint16_t jump;                  /* 1/16 LSB; 0 = not judged */
    uint16_t rise, fall;            /* 1/16 LSB in 64 samples */
};

struct signal_test {
    struct signal_test_limits limits;
    uint8_t kind;               /* planned or under way; NONE: nothing */
    uint8_t before_kind;        /* of the test before */
    uint8_t begun, ended;
    uint8_t bad_moves, bad_offs, bad_jumps, bad_idles;
    uint8_t learned_moves;
    uint32_t due;               /* no test begins before this sample */
    uint32_t planned;
    uint32_t from, to;          /* skipped samples: from, and up to but not including to once ended */
    uint32_t before, inside, after; /* sums */
    uint32_t learned;           /* sum of so many moves in 1/32 LSB */
    uint32_t jump_end;          /* sample after the block that the next is compared with */
    uint32_t jump_sum;
    uint16_t jump_count, jump_phase; /* 0 samples: there is none */
};

/* No rule is on. */
void signal_test_init(struct signal_test *t);
/* 0 if a lower limit is above its upper one or tests would leave no room for others (nothing is changed), 1 if taken. */
uint8_t signal_test_configure(struct signal_test *t, struct signal_test_limits limits);
/* Is a test due for the block that samples from `index` on go into? */
uint8_t signal_test_is_due(const struct signal_test *t, uint32_t index);
/* The kind to begin at sample `at`, under `phase`; NONE if there is none for it. */
enum signal_test_kind signal_test_plan(struct signal_test *t, uint32_t at, uint16_t phase);
/* How many samples lie between its beginning and its end. */
uint16_t signal_test_length(const struct signal_test *t);
/* It begins with this sample; it ends with it, and `settle` samples after the bridge is on again samples are good. */
void signal_test_begin(struct signal_test *t, uint32_t index);
void signal_test_end(struct signal_test *t, uint32_t index, uint16_t settle);
/* The drive steps, or samples were lost: ends without a verdict.  Returns the kind that must be undone. */
enum signal_test_kind signal_test_cancel(struct signal_test *t, uint32_t index, uint16_t settle);
/* Neither this nor feed needs to be called while kind and begun are 0.
 * Are samples from `index` on to be skipped?  *run: for how many of the next `count` (>= 1) that holds. */
uint8_t signal_test_run(struct signal_test *t, uint32_t index, uint16_t count, uint16_t *run);
/* All samples, skipped or not, in order.  Returns the trip they cause. */
enum guard_trip signal_test_feed(struct signal_test *t, const uint16_t *samples, uint32_t index, uint16_t count);
/* How far the signal moves on this board, 1/16 LSB; 0 while that is being learned. */
uint16_t signal_test_moved(const struct signal_test *t);
/* Needs not be called while limits.interval is 0.  A finished block whose first sample is `first`.  Returns the trip it causes. */
enum guard_trip signal_test_block(struct signal_test *t, const struct guard_input *block, uint32_t first);

#endif
