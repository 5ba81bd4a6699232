// What a real machine adds to the nozzle of plant.c: each effect has its parameters, and is absent while they are at the
// values of preset `reference`. Equations: plant_effects.c.
#ifndef FERRITE_SIM_PLANT_EFFECTS_H
#define FERRITE_SIM_PLANT_EFFECTS_H

#include "plant_noise.h"

struct plant;
struct tank_drive;
struct tank_point;

enum { WALL_MODES = 6, LAW_ERROR_TERMS = 4 };

struct plant_effects {
    int wall, tip, parts, bus, moves; // present
    int live_power;                   // the heat changes without a step of the drive
    int live_drive;                   // the tank changes without one
    int noisy;                        // disturbances at the ADC beside white noise
    double bus_v;                     // at the bridge, behind supply_ohm
    double coil_c, cap_c, choke_c;
    double wall_k[WALL_MODES]; // skin above the wall's mean, by modes of diffusion
    double tip_k;              // tip below the bore
    double head, way_mm;       // the head's place, -1..1 from end to end of its travel; way of its motors
    double random_um, coloured, emi_in_phase, emi_quadrature; // filtered noise
    double law_error[LAW_ERROR_TERMS];
    struct noise_source noise;
};

void effects_init(struct plant *p, uint64_t seed);
void effects_changed(struct plant *p); // a parameter changed
// Bus, temperatures of the parts, wall, tip, random movement. air_w: the nozzle's loss to the air.
void effects_advance(struct plant *p, double dt_s, double power_w, double air_w);
// Components of the tank as they are now.
void effects_drive(const struct plant *p, struct tank_drive *d);
// Added to the ADC's level during the next dt_s, LSB; t_s: plant time.
double effects_disturbance(struct plant *p, double t_s, double dt_s);
double effects_bus_code(struct plant *p, double full_scale_v); // of vdc_pin, 0..1 of full scale and beyond

#endif
