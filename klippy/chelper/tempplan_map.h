#ifndef FERRITE_TEMPPLAN_MAP_H
#define FERRITE_TEMPPLAN_MAP_H
/* Which road lies on top in each column of a square grid, and how warm it is. */
#include <stdint.h>

#include "tempplan.h"

struct road {
    double time_s, z_mm, thick_mm;
    double laid_c[TEMPPLAN_HISTORIES], base_c[TEMPPLAN_HISTORIES];
};

struct column {
    int32_t x, y;
    uint8_t used, has_under;
    double odometer_mm;             /* path laid when it was last touched */
    double met_c[TEMPPLAN_HISTORIES];  /* substrate the present pass met */
    struct road top, under;
};

struct deposit_map {
    struct column *columns;
    uint64_t used, mask;
    double odometer_mm;
};

int map_init(struct deposit_map *map);
void map_free(struct deposit_map *map);
/* Room for `more` columns; 0, or -1: no memory. */
int map_reserve(struct deposit_map *map, uint64_t more);
struct column *map_column(struct deposit_map *map, int32_t x, int32_t y);

#endif
