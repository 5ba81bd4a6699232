// The simulated induction nozzle: heat, drive, resonant tank and ADC. Pure C, doubles; knows no MCU and no clock.
//
//   phase, fan, flow ─► drive ─► skin ─► bore ─► melt          plant_advance: thermal time
//                         │        └──► second mass ─► air
//                         └► LCL tank ─► error ─► ADC codes    plant_sample: one code a bridge period
//
// Theory, equations and their origins: klippy/simulation/plant/plant.c, plant_tank.c, plant_bridge.c,
// plant_effects.c, plant_noise.c.
//
// Who advances what. Thermal time passes only in plant_advance. Electrical time (the tank's settling after a phase
// step) passes with the samples taken; where nobody samples for 5 ms the tank counts as settled. Call order for an
// interval: plant_set_phase at its start (a period edge), then plant_advance and plant_sample over it, in any order;
// the temperature is held during one plant_sample call, so keep calls under 1 ms (0.3 degC at 282 W).
// Same values, seed and calls give the same numbers, bit for bit, in one build.
#ifndef FERRITE_SIM_PLANT_H
#define FERRITE_SIM_PLANT_H

#include <stdint.h>

#include "plant_effects.h"
#include "plant_noise.h"
#include "plant_params.h"
#include "plant_tank.h"

enum plant_param_id {
#define PLANT_ID(name, unit, reference, strong, real, lo, hi, doc) PLANT_##name,
    PLANT_PARAM_TABLE(PLANT_ID)
#undef PLANT_ID
        PLANT_PARAM_COUNT
};

enum plant_fault {
    PLANT_OK = 0,
    PLANT_NO_NOZZLE = 1,    // empty coil: no heat into the metal, the tank is far off resonance
    PLANT_COIL_BROKEN = 2,  // no current: no heat and no signal
    PLANT_BRIDGE_STUCK = 3, // the bridge stays at fault_phase_ticks whatever is commanded
    PLANT_SIGNAL_STUCK = 4, // every code the same, heating goes on
    PLANT_SIGNAL_LOST = 5,  // sensing lead open: adc_zero and noise, heating goes on
    PLANT_LEG_DEAD = 6,     // the other leg goes on switching: half the voltage whatever the phase, and another phase
    PLANT_SUPPLY_SHORT = 7, // both switches of a leg conduct: no voltage at the bridge
    PLANT_SENSE_SHORT = 8,  // sensing lead shorted: code 0
    PLANT_SIGNAL_HELD = 9,  // the signal stays what it was; noise of fault_noise_lsb goes on
};

// One row of the parameter table, for config readers and documentation.
struct plant_param {
    const char *name, *unit, *doc;
    double reference, strong, real, min, max;
};
extern const struct plant_param plant_params[];
extern const int plant_param_count;

struct plant_values {
#define PLANT_FIELD(name, unit, reference, strong, real, lo, hi, doc) double name;
    PLANT_PARAM_TABLE(PLANT_FIELD)
#undef PLANT_FIELD
};

struct plant {
    struct plant_values v;
    // inputs
    double phase_ticks;  // commanded
    double flow_in, fan; // mm^3/s at the motor, 0..1
    double moved_ns;     // sampling instant, moved by the board
    int supply_open;     // the switch in the bridge's supply has opened
    // thermal state
    double time_s;
    double mean_c;          // of the heated wall, which holds the heat
    double skin_c, tip_c;   // above it by the heat's way through the wall; where the melt leaves the steel
    double second_c, bore_c;
    double flow;                    // mm^3/s at the nozzle, behind flow_tau_s
    double drive_w;                 // into the metal below the Curie point, as of the last step of the drive
    double melt_w;                  // heat going into the melt now
    double metal_j, lost_j, melt_j; // heat put into the metal, lost to the air, carried off by melt, since the start
    struct plant_lags {
        double dt_s, bore, flow;
    } lags; // exp(-dt/tau) of the last step length
    struct plant_effects effects;
    // electrical
    double unsampled_s; // thermal time since the last sample
    double period_s;    // bridge period, as last seen in plant_sample
    struct tank tank;
    struct noise_source noise;
    int last_code;
    float last_level; // of the signal, in codes
};

struct plant_outputs {
    double skin_c, mean_c, bore_c, tip_c, second_c;
    double melt_c;       // as it leaves the nozzle (at the tip's temperature without flow)
    double coil_c;       // the heating coil's copper
    double supply_v;     // at the bridge
    double power_w;      // into the metal
    double electrical_w; // drawn from the supply by the bridge
    double flow_mm3_s;   // through the nozzle, smoothed
};

// Put everything at start_c, bridge off. values: plant_param_count doubles in table order, taken as they are (whoever
// reads a config checks min and max).
void plant_init(struct plant *p, const double *values, uint64_t seed);
struct plant *plant_new(void); // memory for callers that do not know the struct (cffi); NULL if there is none
void plant_free(struct plant *p);
int plant_param_index(const char *name);                        // -1 if there is no such parameter
void plant_set_param(struct plant *p, int index, double value); // at run time: faults, drifts, disturbances
double plant_get_param(const struct plant *p, int index);
void plant_set_phase(struct plant *p, double phase_ticks); // 0..45000, from now on; 0 = bridge off
void plant_set_supply(struct plant *p, int open);          // the switch between supply and bus
void plant_set_inputs(struct plant *p, double flow_mm3_s, double fan);
void plant_move_sampling(struct plant *p, double late_ns); // on top of skew_ns, until the next call
void plant_set_head(struct plant *p, double place, double way_mm); // place: -1..1; way: of the motors that move it
void plant_advance(struct plant *p, double dt_s); // sub-steps of at most 10 ms inside
// n ADC codes at consecutive bridge periods, the first one at the present instant. About 1 to 3 ns a sample.
void plant_sample(struct plant *p, uint16_t *out, uint32_t n, double period_s);
void plant_read(const struct plant *p, struct plant_outputs *out);
double plant_phase_in_force(const struct plant *p);
int plant_fault_is(const struct plant *p, enum plant_fault fault);
double plant_back_force(const struct plant *p); // of the melt against the filament, N; what the drive can give at most
double plant_supply(const struct plant *p);        // at the bridge, ripple included
double plant_electrical_power(const struct plant *p, double metal_w); // at full supply, metal_w at least
double plant_loaded_supply(const struct plant *p); // what it settles to at this drive, without ripple
// Heat balance since the start, in J: put into the metal, lost to air, carried off by melt, stored now.
struct plant_balance {
    double metal_j, lost_j, melt_j, stored_j;
};
void plant_energy(const struct plant *p, struct plant_balance *out);

#endif
