#ifndef CHELPER_PHYSICS_H
#define CHELPER_PHYSICS_H
// Constants of nature, as in klippy/thermal/models/heat_loss.py.

#define STEFAN_BOLTZMANN 5.670374e-8 // W/m^2K^4
#define ZERO_CELSIUS_K 273.15

#endif
