// Gaussian noise at a nanosecond a sample. Quality and method: plant_noise.c.
#ifndef FERRITE_SIM_PLANT_NOISE_H
#define FERRITE_SIM_PLANT_NOISE_H

#include <stdint.h>

enum { NOISE_RUN = 128 }; // longest run one noise_run call serves

struct noise_source {
    uint64_t state;
};

void noise_seed(struct noise_source *n, uint64_t seed);
uint64_t noise_bits(struct noise_source *n); // 64 even bits
// Three rows of at least NOISE_RUN numbers; sign[i] * (a[i] + b[i]) is white, Gaussian, mean 0, rms 1.
struct noise_rows {
    const float *a, *b, *sign;
};
struct noise_rows noise_run(struct noise_source *n);

#endif
