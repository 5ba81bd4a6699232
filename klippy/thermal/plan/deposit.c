/* The grid of columns as an open-addressed hash table: memory goes with the area of the part. */
#include "deposit.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { FIRST_COLUMNS = 1024 };

/* As in test/reference/deposit_reference.py, where the reasons are. */
static const double SAME_PASS_CELLS = 1.5, SAME_LAYER = 0.5, NEXT_LAYER = 1.5, TAKEN_OFF_MM = 2.0;
static const double FAR_MM = 3.0, FIRST_STEP = 0.4, GROWTH = 2.5, MIN_COVER = 0.05, MIN_MM2 = 1e-6;

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
    *map = (struct deposit_map){ .mask = FIRST_COLUMNS - 1, .air_z_mm = NAN };
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
        *c = (struct column){ .x = x, .y = y, .used = 1, .kept = 1.0 };
        map->used++;
    }
    return c;
}

/* -- a column's heat -- */

/* Loops over the nodes of a stack: nearly every stack is full, and with a count known in advance they are unrolled. */
#define PER_NODE _Pragma("GCC unroll 6")
#define ALWAYS_INLINE inline __attribute__((always_inline))

/* Arrays begin as zeros, though only what the `count` nodes need is read: gcc's analyzer cannot follow that. In a full stack,
 * where all of it is written, that costs nothing. */

/* Of the balance of the nodes: mass, exchange with the next, and with the surroundings, all in mm and mm/s. */
struct balance {
    double mass[STACK_NODES], link[STACK_NODES], out[STACK_NODES], gain[STACK_NODES];
};

static double around_c(struct deposit_map *map, const struct tempplan_params *p, double z_mm)
{
    if (z_mm != map->air_z_mm) {
        map->air_z_mm = z_mm;
        map->air_c = p->chamber_c + (p->bed_c - p->chamber_c) * exp(-greater(0.0, z_mm) / p->bed_reach_mm);
    }
    return map->air_c;
}

static double cover_of(const struct column *c)
{
    return c->below_mm2 <= 0.0 ? 1.0 : lesser(1.0, greater(MIN_COVER, c->area_mm2 / c->below_mm2));
}

static ALWAYS_INLINE void set_balance(struct balance *b, int count, const struct column *c,
                                      const struct tempplan_params *p, double air_c, double fan)
{
    double alpha = 1e6 * p->diffusivity_m2_s, cover = cover_of(c), height_mm = 0.0;
    double loss = 1e3 * (p->still_w_m2k + fan * p->fan_w_m2k) / p->rho_c;
    int last = count - 1;
    PER_NODE for (int i = 0; i <= last; i++) {
        height_mm += c->thick_mm[i];
        b->mass[i] = c->thick_mm[i] * (i ? 1.0 : cover);
        b->out[i] = loss * c->side_per_mm * b->mass[i];
        if (i < last)
            b->link[i] = 2.0 * alpha / (c->thick_mm[i] + c->thick_mm[i + 1]);
    }
    b->out[0] += loss * cover;
    if (last) {
        b->link[0] *= cover;
        b->out[1] += loss * (1.0 - cover);
    }
    PER_NODE for (int i = 0; i <= last; i++)
        b->gain[i] = b->out[i] * air_c;
    if (height_mm >= c->z_mm - SAME_LAYER * c->thick_mm[0]) {      /* the stack reaches the bed */
        b->out[last] += 2.0 * alpha / c->thick_mm[last];
        b->gain[last] += 2.0 * alpha / c->thick_mm[last] * p->bed_c;
    }
}

/* The matrix mass + part (links + out) of one step, three diagonals, taken apart: inverse pivots, and the links times
 * these. Each node waits for the one before: as little as can be is worked out on that way. */
struct matrix {
    double lower[STACK_NODES], inverse[STACK_NODES], upper[STACK_NODES];
};

static ALWAYS_INLINE void solve(const struct matrix *m, int count, pair *temps)
{
    temps[0] *= m->inverse[0];
    PER_NODE for (int i = 1; i < count; i++)
        temps[i] = temps[i] * m->inverse[i] + m->lower[i] * temps[i - 1];
    PER_NODE for (int i = count - 2; i >= 0; i--)
        temps[i] += m->upper[i] * temps[i + 1];
}

/* Two stages with the same matrix, second order, L-stable (deposit_reference.py, _step). */
static ALWAYS_INLINE void step(const struct balance *b, int count, pair *temps, double step_s)
{
    static const double gamma = 0.29289321881345254;    /* 1 - 1/sqrt(2) */
    struct matrix m = { .lower = { 0.0 } };
    double part_s = gamma * step_s, above = 0.0;
    pair first[STACK_NODES] = { { 0.0 } };
    PER_NODE for (int i = 0; i < count; i++) {
        double below = i + 1 < count ? part_s * b->link[i] : 0.0;
        m.inverse[i] = 1.0 / (b->mass[i] + above + below + part_s * b->out[i] -
                              (i ? above * above * m.inverse[i - 1] : 0.0));
        m.lower[i] = above * m.inverse[i];
        m.upper[i] = below * m.inverse[i];
        above = below;
        first[i] = b->mass[i] * temps[i] + part_s * b->gain[i];
    }
    solve(&m, count, first);
    PER_NODE for (int i = 0; i < count; i++) {
        pair between_c = temps[i] + (1.0 - gamma) / gamma * (first[i] - temps[i]);
        temps[i] = b->mass[i] * between_c + part_s * b->gain[i];
    }
    solve(&m, count, temps);
}

static ALWAYS_INLINE void cool_for(struct column *c, int count, const struct tempplan_params *p, double left_s,
                                   double air_c, double fan)
{
    struct balance b = { .mass = { 0.0 } };
    set_balance(&b, count, c, p, air_c, fan);
    double step_s = FIRST_STEP * c->thick_mm[0] * c->thick_mm[0] / (1e6 * p->diffusivity_m2_s);
    while (left_s > 0.0) {
        double now_s = left_s < 1.5 * step_s ? left_s : step_s;
        step(&b, count, c->temp_c, now_s);
        left_s -= now_s;
        step_s *= GROWTH;
    }
}

static void cool(struct deposit_map *map, struct column *c, const struct tempplan_params *p, double time_s, double fan)
{
    double left_s = time_s - c->time_s;
    int count = c->nodes;
    if (left_s <= 0.0 || count < 1)
        return;
    c->time_s = time_s;
    double air_c = around_c(map, p, c->z_mm);
    if (count < STACK_NODES)
        cool_for(c, count, p, left_s, air_c, fan);
    else
        cool_for(c, STACK_NODES, p, left_s, air_c, fan);
}

/* -- depositing -- */

static pair both(double temp_c)
{
    return (pair){ temp_c, temp_c };
}

/* An empty layer on top; the two lowest become one when there is no room. */
static void begin_layer(struct column *c, const struct tempplan_params *p, const struct dab *dab)
{
    if (c->nodes)
        c->side_per_mm = 2.0 * (1.0 - lesser(1.0, c->area_mm2 / (p->cell_mm * p->cell_mm))) / dab->width_mm;
    c->below_mm2 = c->area_mm2;
    c->area_mm2 = 0.0;
    c->z_mm = dab->z_mm;
    if (c->nodes == STACK_NODES) {
        double a = c->thick_mm[STACK_NODES - 2], b = c->thick_mm[STACK_NODES - 1];
        c->temp_c[STACK_NODES - 2] = (a * c->temp_c[STACK_NODES - 2] + b * c->temp_c[STACK_NODES - 1]) / (a + b);
        c->thick_mm[STACK_NODES - 2] = fmin(FAR_MM, a + b);
        c->nodes--;
    }
    memmove(c->thick_mm + 1, c->thick_mm, c->nodes * sizeof(c->thick_mm[0]));
    memmove(c->temp_c + 1, c->temp_c, c->nodes * sizeof(c->temp_c[0]));
    c->thick_mm[0] = dab->thick_mm;
    c->temp_c[0] = both(0.0);
    c->nodes++;
}

/* Nothing lies right below: a leaning wall. Its road lies on the stack of a neighbour. */
static void adopt(const struct deposit_map *map, struct column *c, const struct dab *dab)
{
    static const int8_t sides[4][2] = { { 1, 0 }, { -1, 0 }, { 0, 1 }, { 0, -1 } };
    for (int i = 0; i < 4; i++) {
        const struct column *other = find(map->columns, map->mask, c->x + sides[i][0], c->y + sides[i][1]);
        if (!other->used || !other->nodes)
            continue;
        double gap_mm = dab->z_mm - other->z_mm;
        int has_this = fabs(gap_mm) < SAME_LAYER * dab->thick_mm;   /* it has this layer already */
        if (gap_mm > NEXT_LAYER * dab->thick_mm || gap_mm <= -SAME_LAYER * dab->thick_mm || other->nodes <= has_this)
            continue;
        c->time_s = other->time_s;
        c->side_per_mm = other->side_per_mm;
        c->z_mm = other->z_mm - (has_this ? other->thick_mm[0] : 0.0);
        c->area_mm2 = has_this ? other->below_mm2 : other->area_mm2;
        c->below_mm2 = other->below_mm2;
        c->nodes = (uint8_t)(other->nodes - has_this);
        memcpy(c->thick_mm, other->thick_mm + has_this, c->nodes * sizeof(c->thick_mm[0]));
        memcpy(c->temp_c, other->temp_c + has_this, c->nodes * sizeof(c->temp_c[0]));
        return;
    }
}

static double air_or_bed_c(struct deposit_map *map, const struct tempplan_params *p, const struct dab *dab)
{
    return dab->z_mm <= NEXT_LAYER * dab->thick_mm ? p->bed_c : around_c(map, p, dab->z_mm);
}

static pair met_c(struct deposit_map *map, const struct column *c, const struct tempplan_params *p,
                  const struct dab *dab, int same_layer)
{
    if (!c->nodes)
        return both(air_or_bed_c(map, p, dab));
    pair top_c = c->temp_c[0];
    if (!same_layer)
        return top_c;
    pair below_c = c->nodes > 1 ? c->temp_c[1] : both(p->bed_c);    /* below it and its neighbour beside it */
    return (dab->width_mm * below_c + dab->thick_mm * top_c) / (dab->width_mm + dab->thick_mm);
}

int column_deposit(struct deposit_map *map, struct column *c, const struct tempplan_params *p, const struct dab *dab,
               struct dab *before)
{
    double odometer_mm = map->odometer_mm;
    if (c->nodes && c->z_mm - dab->z_mm > TAKEN_OFF_MM)
        *c = (struct column){ .x = c->x, .y = c->y, .used = 1, .kept = 1.0 };
    int same_layer = c->nodes && fabs(c->z_mm - dab->z_mm) < SAME_LAYER * dab->thick_mm;
    int same_pass = same_layer && odometer_mm - c->odometer_mm <= SAME_PASS_CELLS * p->cell_mm;
    double gap_mm = dab->z_mm - (c->nodes ? c->z_mm : 0.0);
    int above = c->nodes && !same_layer && gap_mm <= NEXT_LAYER * dab->thick_mm;
    if (!same_layer && gap_mm > NEXT_LAYER * dab->thick_mm)
        adopt(map, c, dab);
    c->odometer_mm = odometer_mm;
    if (!same_pass) {
        cool(map, c, p, dab->time_s, dab->fan);
        c->time_s = dab->time_s;
        c->met_c = met_c(map, c, p, dab, same_layer);
    }
    if (!same_layer) {
        before->time_s = c->deposited_s;
        before->clock = c->clock;
        c->deposited_s = dab->time_s;
        c->clock = dab->clock;
        begin_layer(c, p, dab);
    }
    double area_mm2 = greater(MIN_MM2, dab->width_mm * dab->length_mm);
    c->area_mm2 += area_mm2;
    double share = area_mm2 / c->area_mm2;
    c->temp_c[0][1] += share * (dab->fixed_c - c->temp_c[0][1]);
    c->kept *= 1.0 - share;
    return above;
}

void column_melt(struct column *c, double melt_c)
{
    c->temp_c[0][0] = c->kept * c->temp_c[0][0] + (1.0 - c->kept) * melt_c;
    c->kept = 1.0;
}
