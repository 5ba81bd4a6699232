/* Timing of the sampling chain: the values that a host's configuration has by default, in the dictionary as INDUCTION_...
 *
 * A host chooses its own with config_induction, config_induction_sense and config_induction_block.
 */
#ifndef INDUCTION_TIMING_H
#define INDUCTION_TIMING_H

enum {
    INDUCTION_FREQUENCY = 120000,  /* samples a second, one a bridge period */
    INDUCTION_OVERSAMPLE = 4,      /* y: a block has 4^y samples or fewer */
    INDUCTION_BLOCK_SAMPLES = 192, /* 1.6 ms */
    INDUCTION_SETTLE_SAMPLES = 20, /* tank settles with 27 us, 18 periods to 0.1 degrees of phase */
    INDUCTION_RECORDS = 3,         /* blocks in a message: one each 4.8 ms */
    INDUCTION_LEAD_US = 15000,     /* from sending a phase to its clock */
};

#endif
