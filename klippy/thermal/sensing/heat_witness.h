#ifndef CHELPER_HEAT_WITNESS_H
#define CHELPER_HEAT_WITNESS_H
// Does the reading follow the heat that was put in? Bounds from both sides, block by block.
//
//   rise, at least   (ratio_low  E - (loss_high (T - Ta) + taken) dt) / C(T)       E: heat by the drive law
//   rise, at most    (ratio_high E -  loss_low  (T - Ta) dt) / C(T)
//   ratio    of heat over heat capacity: measured during each heat-up, wide bounds before
//   missing  = what the reading rose less than that, summed up, forgotten over MEMORY_S, never below 0
//   surplus  = what it rose more, likewise
//
// A signal that stands still under noise, loses gain or jumps shows as one of the two; so does a bridge that heats by
// itself. Only readings that are exact on their own count: at little drive, or at a look within a strong one.

#include <stdint.h>

struct coil_block;
struct filter_params;

// Filled by Python; what changes while a nozzle is in use.
struct witness_inputs {
    double loss_low_w_k, loss_high_w_k;     // into everything but filament and fan
    double taken_w;                         // max of what filament and fan take
    double slack_c;                         // beyond noise: disturbances of the signal, errors of the law
    double target_c, room_c;                // the nozzle may be so far above the highest of target and way down to it
    int32_t is_on;
};

struct witness_state {
    struct witness_inputs inputs;
    double block_s;                         // end of the newest block
    double end_s, temp_c, sigma_c;          // of the block used last; NaN: none
    double heat_j, peak_w;                  // since then; highest of late
    double ratio;                           // of heat over heat capacity, true over set up; 0: not measured yet
    double run_heat_k, run_rise_k;          // of the heat-up under way: by the heat, and by the reading with its losses
    double run_known_k;                     // ... rise at which it gave the ratio
    double missing_c, surplus_c, allowed_c;
    double beyond_s;                        // since when one of them is more than allowed; NaN: they are not
    double base_c;                          // target, or the lowest reading on the way down to it
    int32_t above;                          // weighted blocks in a row above that by more than room_c
    int32_t is_tripped;                     // enum witness_trip: stays
};

enum witness_trip { WITNESS_GOOD, WITNESS_MISSING, WITNESS_SURPLUS, WITNESS_ABOVE };

void witness_reset(struct witness_state *s);
void witness_block(struct witness_state *s, const struct filter_params *p, double phase_max, const struct coil_block *b);

#endif
