/* Step generation. */
#ifndef STEPPER_H
#define STEPPER_H

#include <stdint.h>

struct stepper;
struct stepper *stepper_lookup(uint8_t oid);

#endif
