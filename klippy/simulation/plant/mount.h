/* Vibration of the extruder's mount: a mass on a spring, shaken by the melt that is pressed through the hole.
 *
 *     x" = w^2 (b - x) + w/Q (b' - x') + f          b: share of the frame's place that reaches the mount, f: noise
 *
 * f is white and Gaussian. Its size is such that the mount rings with an amplitude (sqrt(2) rms, m/s^2) of
 *
 *     amplitude (F/F0)^(exponent/c) (v/v0)^(flow_exponent - n exponent/c)
 *
 * F: force against the filament (plant_back_force), which goes with hole^-c v^n; F0, v0: at 0.4 mm and 5 mm^3/s. So
 * the amplitude goes with hole^-exponent and v^flow_exponent. The form of the law in the hole's diameter is Tlegenov
 * 2018's measurement; those in flow and temperature are assumed.
 */
#ifndef FERRITE_MOUNT_H
#define FERRITE_MOUNT_H

#include "frame.h"
#include "plant.h"
#include "plant_noise.h"

struct mount {
    double frequency_hz, quality;
    double amplitude_m_s2, exponent, flow_exponent, motion_share;
    double force; /* rms of f in steps of a second, m/s^2 s^0.5 */
    double x, rate;    /* mm, mm/s */
    double step_s, spring, drag, push; /* a step, and what it adds to the rate */
    struct noise_source noise;
    struct noise_rows rows;
    int left; /* of those rows */
};

void mount_init(struct mount *m, double place_mm, uint64_t seed);
/* What the nozzle does now. */
void mount_follow(struct mount *m, const struct plant *p);
/* From now on steps of step_s. */
void mount_set_step(struct mount *m, double step_s);
/* A step with the mount's base at base_mm. */
void mount_step(struct mount *m, double base_mm, double base_rate);

#endif
