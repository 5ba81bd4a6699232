/* The induction heater's own limits: they hold with the host dead, are configured once before use, and are off until then.
 * Pure: no board; blocks and clocks come in as arguments, "trip now" comes out.
 *
 * Table: rows of ascending phase.  A row holds from its phase up to the next row's (stepwise, so no division); below the
 * first row, and with an empty table, blocks are not judged.  A block is bad if
 *     low     its mean is below the row's low             sum < low * count
 *     high    its mean is above the row's high            sum > high * count
 *     clipped its mean is within, but a sample is at an end of the ADC (0, or adc_max and above)
 *     stuck   all its samples are equal, and have been on this code while the phase moved by GUARD_STUCK_STEP: then a
 *             live signal moves by 2 LSB and more. A front end without noise stays on one code for long at one phase
 * in this order of precedence.  trip_blocks bad blocks in a row trip, whatever is wrong with each; a good block, or
 * one that is not judged, starts the count again.  low = 0 and high = 65535 leave only the last two.
 *
 * Silent host: with power on, a phase command must be applied at least every max_duration ticks.  Else the power lapses:
 * the caller switches off, and the next phase command ends the lapse.  No command for `silence` ticks in all trips.
 *
 * Ceiling: from a phase on, a row's high limit is lowered to low + share/65536 of the way to it, so that a nozzle that is driven
 * hard is not driven far beyond its target.  It follows the target at run time.  Share 65535 leaves the row as it is.
 *
 * The first trip is latched with the value that caused it; only guard_init clears it.
 * Formats: u16 limits and counts, u32 sums; low * count <= 65535 * 65535 < 2^32.
 * Contexts: guard_block in the ADC's interrupt once a block, about 40 cycles and a few for each row; the rest in the
 * timer interrupt.
 */
#ifndef GUARD_H
#define GUARD_H

#include <stdint.h>

enum { GUARD_ROWS_MAX = 12, GUARD_STUCK_STEP = 8192 /* ticks */ };

enum guard_trip {
    GUARD_TRIP_NONE = 0,
    GUARD_TRIP_LOW = 1,
    GUARD_TRIP_HIGH = 2,
    GUARD_TRIP_CLIPPED = 3,
    GUARD_TRIP_STUCK = 4,
    GUARD_TRIP_TIMEOUT = 5,
    GUARD_TRIP_UNMOVED = 6,  /* these three: signal_test.h */
    GUARD_TRIP_CONDUCTS = 7,
    GUARD_TRIP_JUMP = 8,
};

struct guard_row {
    uint16_t phase, low, high; /* ticks; raw LSB of a single sample */
    uint8_t trip_blocks;       /* 0 = do not judge from this phase on */
};

/* The part of a block the guard looks at. */
struct guard_input {
    uint32_t sum;
    uint16_t count, phase, min, max;
};

struct guard {
    uint32_t max_duration; /* ticks */
    uint32_t silence;      /* ticks */
    uint32_t fed_clock;    /* when a phase command was last applied */
    uint32_t trip_value;   /* sum of the tripping block; for TIMEOUT the clock */
    uint16_t trip_count;   /* samples in that sum */
    uint16_t adc_max;
    uint16_t ceiling_phase, ceiling_share;
    uint8_t trip;          /* enum guard_trip, latched */
    uint8_t bad_blocks;    /* in a row */
    uint8_t row_count;
    uint8_t powered;       /* phase > 0 in force */
    uint8_t lapsed;        /* was in force, but no command came in time */
    uint8_t is_stuck;      /* still on flat_code after a step of the phase */
    uint16_t flat_code, flat_phase; /* the one code of the newest blocks, UINT16_MAX: none; phase of their first */
    struct guard_row rows[GUARD_ROWS_MAX];
};

void guard_init(struct guard *g, uint16_t adc_max, uint32_t max_duration, uint32_t silence);
/* 0 if the table is full, the phase does not ascend or low > high; 1 if taken. */
uint8_t guard_add_row(struct guard *g, struct guard_row row);
void guard_set_ceiling(struct guard *g, uint16_t phase, uint16_t share);
/* A trip found elsewhere.  Returns it, or GUARD_TRIP_NONE when already tripped. */
enum guard_trip guard_latch(struct guard *g, enum guard_trip trip, uint32_t value, uint16_t count);
/* Judge a block; returns the trip it causes (GUARD_TRIP_NONE also when already tripped). */
enum guard_trip guard_block(struct guard *g, const struct guard_input *block);
/* A phase command was applied at `clock`. */
void guard_fed(struct guard *g, uint32_t clock, uint16_t phase);
/* The bridge is off for good: nobody need command it. */
void guard_off(struct guard *g);
/* Must a command come? */
uint8_t guard_is_waiting(const struct guard *g);
/* The clock by which it must have come.  Meaningful while waiting. */
uint32_t guard_deadline(const struct guard *g);
/* 1 when the power lapses now. */
uint8_t guard_lapse(struct guard *g, uint32_t clock);
/* Has the silence lasted too long?  Trips if so. */
enum guard_trip guard_check_silence(struct guard *g, uint32_t clock);

#endif
