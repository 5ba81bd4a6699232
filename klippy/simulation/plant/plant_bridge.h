// What dead time, saturation and the steel's resistance do, by tables of a circuit simulation. Origin: plant_bridge.c.
#ifndef FERRITE_SIM_PLANT_BRIDGE_H
#define FERRITE_SIM_PLANT_BRIDGE_H

// Dead time: degrees added to the phase of the coil's current, and the logarithm of the share left of its size.
struct bridge_shift {
    double psi_deg, log_current;
};
// supply: over its nominal value.
struct bridge_shift bridge_dead_time(double dead_ns, double phase_ticks, double steel_c, double supply);
// Effect of temperature on L1 at coil current x (of l1_saturation_a), 1 at small current.
double coil_saturation_at(double x);
// Relative change of the tank's resistance with the steel's temperature and x, for a rise of 3e-4/K.
double coil_resistance_at(double steel_c, double x);

#endif
