/* The grid of columns as an open-addressed hash table: memory goes with the area of the part. */
#include "tempplan_map.h"

#include <stdlib.h>

enum { FIRST_COLUMNS = 1024 };

static uint64_t place(int32_t x, int32_t y)
{
    uint64_t key = (uint64_t)(uint32_t)x << 32 | (uint32_t)y;
    key *= 0x9e3779b97f4a7c15u;     /* 2^64 over the golden ratio: neighbours land far apart */
    return key ^ key >> 29;
}

static struct column *find(struct column *columns, uint64_t mask, int32_t x, int32_t y)
{
    for (uint64_t i = place(x, y) & mask;; i = (i + 1) & mask) {
        struct column *c = &columns[i];
        if (!c->used || (c->x == x && c->y == y))
            return c;
    }
}

int map_init(struct deposit_map *map)
{
    *map = (struct deposit_map){ .mask = FIRST_COLUMNS - 1 };
    map->columns = calloc(FIRST_COLUMNS, sizeof(*map->columns));
    return map->columns ? 0 : -1;
}

void map_free(struct deposit_map *map)
{
    free(map->columns);
}

int map_reserve(struct deposit_map *map, uint64_t more)
{
    uint64_t size = map->mask + 1;
    while ((map->used + more) * 4 > size * 3)
        size *= 2;
    if (size == map->mask + 1)
        return 0;
    struct column *grown = calloc(size, sizeof(*grown));
    if (!grown)
        return -1;
    for (uint64_t i = 0; i <= map->mask; i++)
        if (map->columns[i].used)
            *find(grown, size - 1, map->columns[i].x, map->columns[i].y) = map->columns[i];
    free(map->columns);
    map->columns = grown;
    map->mask = size - 1;
    return 0;
}

struct column *map_column(struct deposit_map *map, int32_t x, int32_t y)
{
    struct column *c = find(map->columns, map->mask, x, y);
    if (!c->used) {
        *c = (struct column){ .x = x, .y = y };
        map->used++;
        c->used = 1;
        c->top.time_s = -1.0;       /* nothing laid yet */
    }
    return c;
}
