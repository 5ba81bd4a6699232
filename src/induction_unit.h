/* The induction heater's state, shared by its commands (inductioncmds.c) and its configuration (inductionconfig.c). */
#ifndef INDUCTION_UNIT_H
#define INDUCTION_UNIT_H

#include "board/bridge_pwm.h"
#include "board/sync_adc.h"
#include "guard.h"
#include "oversample.h"
#include "phase.h"
#include "sched.h"
#include "signal_test.h"

#ifdef PORT_SYNC_HALF_LEN
enum { HALF_LEN = PORT_SYNC_HALF_LEN };
#else
enum { HALF_LEN = 32 };
#endif

enum {
    BLOCKS_WAITING_MAX = 32, /* power of two; 51 ms of blocks of 192 samples for a host link that stalls */
};

struct induction {
    struct timer timer, test_timer;
    struct bridge_pwm bridge;
    struct sync_adc adc;
    uint32_t period_ticks, start_clock;
    uint32_t next_index;    /* first sample not yet accounted for */
    uint32_t hold_samples;  /* how long a lone record waits */
    uint8_t oid, sampling, reporting, resync;
    uint8_t records;        /* sent together */
    struct phase_schedule schedule;
    struct oversample oversample;
    struct guard guard;
    struct signal_test test;
    /* finished blocks, irq to task: numbers run, places are modulo the length */
    struct oversample_block waiting[BLOCKS_WAITING_MAX];
    struct oversample_block surplus;  /* one that finds no place */
    uint32_t newest_sum;
    uint16_t newest_count;
    uint16_t sequence;      /* of the oldest waiting block */
    uint8_t block_head, block_tail;
};

struct command_args;

/* The one there is, or NULL. */
struct induction *induction_unit(void);
void induction_use(struct induction *u);
/* The one a command's first parameter names; shuts down if there is none. */
struct induction *induction_of(const struct command_args *args);

uint8_t induction_phase_timer(struct timer *t);
uint8_t induction_test_timer(struct timer *t);
void induction_samples(const uint16_t *samples, uint16_t count);

#endif
