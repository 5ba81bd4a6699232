#ifndef FERRITE_TEMPPLAN_BEST_H
#define FERRITE_TEMPPLAN_BEST_H
/*
 * The least squares path under slope limits: temperatures T of nodes in order of time, each bounded and no farther from
 * the one before than `fall_c` down and `rise_c` up, with the minimum sum of weight (T - target)^2.
 * The theory is in thermal/plan/set_points.py.
 */

struct best_node {
    double time_s, weight, wanted_c;
    double low_c, high_c;           /* of the window at its own flow */
    double bound_low_c, bound_high_c;   /* broken only where the limits leave no other choice */
    double melt_w_k;                /* what the melt takes meanwhile */
    double fall_c, rise_c;          /* limits on the way here */
    double temp_c;                  /* result */
    int stretch;                    /* number of the stretch of the same request that it belongs to */
};

/* How fast the nozzle may go from start_c to end_c, K/s. */
typedef double (*best_rate)(const void *nozzle, double start_c, double end_c, double melt_w_k);

struct knot {
    double at_c, slope;
};

/* Knots of a derivative on one side of its zero, the nearest last. What happens to all of them at once is kept aside:
 * a knot truly lies at at_c + shift, and its value there is slope + gain at + offset. */
struct flank {
    struct knot *knots;
    int count;
    double shift, gain, offset;
};

struct best_path {
    struct best_node *nodes;
    int count, room;
    struct flank below, above;
};

/* Room for one more node, all zero; NULL: no memory. */
struct best_node *best_more(struct best_path *path);
/* From start_c at from_s. */
void best_solve(struct best_path *path, double from_s, double start_c, best_rate rate, const void *nozzle);
void best_free(struct best_path *path);

#endif
