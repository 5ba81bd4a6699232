// The LCL tank and the limited, phase-like signal taken from it. Equations: plant_tank.c.
#ifndef FERRITE_SIM_PLANT_TANK_H
#define FERRITE_SIM_PLANT_TANK_H

struct plant_values;

// What the tank does in the steady state at one temperature.
struct tank_point {
    double i_re, i_im, offset;
}; // coil current in A (peak), error at current phase 0

// The drive seen by the tank.
struct tank_drive {
    double phase_ticks, supply_v, frequency_hz, c1_uf, l2_uh;
    double l1_factor, l1_add_uh, r_add_ohm; // on top of the parameters and what the steel does
    double late_ns, signal_error;            // sampling instant, error of this machine's signal
    int empty, open; // no nozzle in the coil; no current path
};

struct tank {
    struct tank_drive drive;
    // Steady state on the two grid temperatures around the present one, so that a batch costs one interpolation.
    double grid_low_c;
    int cached;
    struct tank_point low, high;
    double low_error, high_error;
    // Settling: the point at the last step, and how much of it is left (1 at the step, 0 = settled).
    struct tank_point from;
    double unsettled;
};

void tank_init(struct tank *t);
void tank_set_drive(struct tank *t, const struct plant_values *v, const struct tank_drive *d, double skin_c);
void tank_changed(struct tank *t); // a parameter changed: forget cached solutions
struct tank_point tank_steady(struct tank *t, const struct plant_values *v, double skin_c);
double tank_steady_error(struct tank *t, const struct plant_values *v, double skin_c); // tank_error, interpolated
struct tank_point tank_now(const struct tank *t, struct tank_point steady);
double tank_error(const struct tank *t, const struct plant_values *v, struct tank_point p);

#endif
