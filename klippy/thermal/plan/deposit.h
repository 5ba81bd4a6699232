#ifndef FERRITE_TEMPPLAN_MAP_H
#define FERRITE_TEMPPLAN_MAP_H
/* What lies in each column of a square grid, layer by layer, and how warm: the readable form is test/reference/deposit_reference.py. */
#include <stdint.h>

#include "planner.h"

/* fmin and fmax for numbers that are none of them NaN: without a call. */
static inline double lesser(double a, double b)
{
    return a < b ? a : b;
}

static inline double greater(double a, double b)
{
    return a > b ? a : b;
}

enum { STACK_NODES = 6 };

/* Extrusion so far: as long as it took, and as long as it would have taken at full speed. */
struct layer_clock {
    double depositing_s, full_speed_s;
};

/* A temperature of both histories: they go through the same sums side by side (gcc and clang know vectors). Aligned as
 * memory is on any computer. */
typedef double pair __attribute__((vector_size(TEMPPLAN_HISTORIES * sizeof(double)), aligned(sizeof(double))));

/* History [0] of the newest layer wait for the piece's melt: `kept` is the share they keep then. */
struct column {
    int32_t x, y;
    uint8_t used, nodes;
    double time_s, z_mm, odometer_mm, area_mm2, below_mm2, side_per_mm, kept;
    struct layer_clock clock;        /* when the newest layer began here */
    double deposited_s;
    double thick_mm[STACK_NODES];
    pair met_c, temp_c[STACK_NODES];
};

struct deposit_map {
    struct column *columns;
    uint64_t used, mask;
    double odometer_mm;
    double air_z_mm, air_c;         /* what is around at the height asked for last; NaN: ask again */
};

/* A short piece of road over one column. */
struct dab {
    double time_s, z_mm, thick_mm, width_mm, length_mm, fan;
    double fixed_c;                 /* melt of history [1] */
    struct layer_clock clock;
};

int map_init(struct deposit_map *map);
void map_free(struct deposit_map *map);
/* Room for `more` columns; 0, or -1: no memory. */
int map_reserve(struct deposit_map *map, uint64_t more);
struct column *map_column(struct deposit_map *map, int32_t x, int32_t y);
/* Deposit it; met_c of the column is then what it met. 1: it is the first of its layer there, on another below, and
 * `before` is what the clocks were for that; else 0. The melt of history [0] follows with column_melt(). */
int column_deposit(struct deposit_map *map, struct column *c, const struct tempplan_params *p, const struct dab *dab,
               struct dab *before);
void column_melt(struct column *c, double melt_c);

#endif
