#ifndef CHELPER_PIPELINE_H
#define CHELPER_PIPELINE_H
// What is done with each block of an induction nozzle's coil, 600 times a second: codes to signal units, signal units to
// a temperature with its uncertainty, the watch on it, the filter, and the sample for a control law with a model.
//
//   blockwire_unpack ─► coil_block ─► front_measure ─► estimate ─► watch ─► filter ─► model_sample
//
// klippy/thermal/sensing/pipeline.py fills the parameters and makes Python's records of what somebody wants to see.

#include "convert.h"
#include "thermal/control/predictive_filter.h"
#include "temperature_filter.h"
#include "drive_offset.h"
#include "heat_witness.h"
#include "laws.h"

// Why a block gives no temperature; the texts are in klippy/thermal/sensing/block_temperature.py.
enum block_fault {
    BLOCK_GOOD,
    BLOCK_OFF,
    BLOCK_CLIPPED,
    BLOCK_LOST,
    BLOCK_FAINT,
    BLOCK_EMPTY,
    BLOCK_OUTSIDE,
};

// Fields are named and measured as in klippy/thermal/records.py.
struct coil_block {
    // as sent
    int64_t sequence, clock;
    double time_s, duration_s, mean_raw;
    int32_t count, min_raw, max_raw, phase_ticks, discarded, lost;
    // of this block alone
    double centre_s, end_s, heat_w;
    double signal_units, noise_units;
    double temp_c, sigma_c, noise_c, c_per_unit;    // NaN unless BLOCK_GOOD
    int32_t fault;                                  // enum block_fault
    // filtered, if tracked: at centre_s
    int32_t is_tracked;
    double tracked_c, tracked_sigma_c, tracked_noise_c;
};

// The analogue front end: what one ADC code means. noise_lsb: of one sample, as configured; what the blocks show counts.
struct front_params {
    double adc_zero_raw, units_per_lsb, noise_lsb;
    int32_t adc_max_raw;
};

struct chain_params {
    struct front_params front;
    struct sensing_law law;
    double residual_units, supply;
    double drift_sigma_c;                           // of the filtered estimate, beside its noise
    double temp_low_c, temp_high_c, empty_c;        // valid; above empty_c the signal is not a nozzle's
    int32_t phase_low_ticks;
    double limit_low_c, limit_high_c;               // watch
    int32_t limit_blocks, is_calibrated, has_looks;
    double power_max_w, power_exponent, power_phase_max_ticks;
    struct filter_params filter;
    int32_t span_samples, span_blocks;              // noise from the span of blocks: nominal length, memory
    double span_per_noise;                          // expected span of a block of that length, in sigma of a sample
    double phase_max_ticks;                         // of the usual drive
    double step_share, usual_s;                     // model_sample: klippy/thermal/sensing/pipeline.py
};

// What supervision has seen of the blocks; times are print times.
struct chain_watch {
    double last_block_s;             // end of the newest block
    double last_valid_s;          // end of the newest one with a temperature
    int32_t fault;              // why the newest one has none
    int32_t beyond;             // consecutive temperatures beyond a limit
    int32_t is_tripped;         // limit_blocks of them: stays
    double tripped_c;           // the one that did it
};

struct chain_state {
    struct chain_watch watch;
    struct filter_state filter;
    struct drive_offset drive;
    struct witness_state witness;
    double heat_j;              // put in since somebody last set this to 0
    double span_lsb;            // running mean of highest minus lowest code
    int32_t spans;              // how many are in it
    double usual_share;         // p = (phase/phase_max)^2 as usual, of blocks with a temperature
};

double drive_power_w(double power_max_w, double exponent, double phase_max_ticks, double phase_ticks);
// centre_s, end_s, signal_units, noise_units and what is wrong with a block before any law is asked.
void front_measure(const struct front_params *p, struct coil_block *blocks, int count);
// temp_c and its kin of one measured block, or why not.
void chain_estimate(const struct chain_params *p, struct coil_block *block);
void chain_watch_block(const struct chain_params *p, struct chain_watch *w, const struct coil_block *block);
void chain_note_span(const struct chain_params *p, struct chain_state *s, const struct coil_block *block);
// Standard deviation of one ADC sample in LSB, from the mean span; NaN before enough blocks.
double chain_noise_lsb(const struct chain_params *p, const struct chain_state *s);
// All of it for blocks in order of time, a sample for each. Index of the newest tracked one, -1: none.
int chain_take(const struct chain_params *p, struct chain_state *s, struct coil_block *blocks, int count,
               struct model_sample *samples);

#endif
