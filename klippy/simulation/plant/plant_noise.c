// Gaussian noise from tables.
//
// Method. Each of two tables holds the 16384 mid-quantiles of a normal distribution of variance 1/2, in an order
// shuffled differently in each. A run adds neighbouring entries of both, starting at two independent random places,
// and multiplies by a third table of random signs (which takes away the 0.5 % of correlation between neighbours that
// tables of this size happen to have).
// Quality, checked in test/c/test_plant_signal.py: rms 1 within 1 %; kurtosis 3 less 0.002; tails to 5.7 sigma (then
// they end); white: within a run because the tables are shuffled, between runs because the places are random. The
// same three places come back every 2^40 runs on average.
//
// The tables are made by the first noise_seed (one thread only) and are the same in every process; only the places
// depend on the seed.
#include "plant_noise.h"

#include <math.h>

static const double sqrt_half = 0.70710678118654752440;
enum { TABLE_BITS = 14, TABLE_SIZE = 1 << TABLE_BITS, SIGN_SIZE = 1 << 12 };

static float table_a[TABLE_SIZE + NOISE_RUN], table_b[TABLE_SIZE + NOISE_RUN], signs[SIGN_SIZE + NOISE_RUN];
static int tables_ready;

// splitmix64 (Steele, Lea, Flood 2014): a counter and a mixing function; any seed will do.
uint64_t noise_bits(struct noise_source *n)
{
    uint64_t z = (n->state += 0x9e3779b97f4a7c15u);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

// Quantiles by Newton steps on the normal distribution function, from the middle outward: each starts at its
// neighbour, so a few steps are enough. Scaled so that the table's own rms is exactly sqrt(1/2).
static void fill_quantiles(float *table)
{
    double z = 0, sum_squares = 0;
    for (int i = 0; i < TABLE_SIZE / 2; i++) {
        const double probability = 0.5 + (i + 0.5) / TABLE_SIZE;
        for (int step = 0; step < 12; step++) {
            const double density = exp(-0.5 * z * z) * 0.3989422804014327;
            z -= (0.5 * erfc(-z * sqrt_half) - probability) / density;
        }
        sum_squares += 2 * z * z;
        table[2 * i] = (float)z;
        table[2 * i + 1] = (float)-z;
    }
    const double scale = sqrt(0.5 * TABLE_SIZE / sum_squares);
    for (int i = 0; i < TABLE_SIZE; i++)
        table[i] = (float)(table[i] * scale);
}

static void shuffle(float *table, uint64_t seed)
{
    struct noise_source order = {seed};
    for (uint32_t i = TABLE_SIZE - 1; i > 0; i--) {
        const uint32_t j = (uint32_t)(((noise_bits(&order) >> 32) * (i + 1)) >> 32);
        const float swap = table[i];
        table[i] = table[j];
        table[j] = swap;
    }
    for (int i = 0; i < NOISE_RUN; i++) // so that a run may start anywhere
        table[TABLE_SIZE + i] = table[i];
}

void noise_seed(struct noise_source *n, uint64_t seed)
{
    if (!tables_ready) {
        fill_quantiles(table_a);
        for (int i = 0; i < TABLE_SIZE; i++)
            table_b[i] = table_a[i];
        shuffle(table_a, 1);
        shuffle(table_b, 2);
        struct noise_source coin = {3};
        for (int i = 0; i < SIGN_SIZE + NOISE_RUN; i++)
            signs[i] = noise_bits(&coin) >> 63 ? 1 : -1;
        tables_ready = 1;
    }
    n->state = seed;
}

struct noise_rows noise_run(struct noise_source *n)
{
    const uint64_t place = noise_bits(n);
    return (struct noise_rows){table_a + (place & (TABLE_SIZE - 1)), table_b + ((place >> 16) & (TABLE_SIZE - 1)),
                               signs + ((place >> 32) & (SIGN_SIZE - 1))};
}
