#ifndef FERRITE_TEMPPLAN_INNER_H
#define FERRITE_TEMPPLAN_INNER_H
/* What the files of the temperature plan share; see planner.h. */
#include "planner.h"
#include "best_path.h"
#include "deposit.h"

struct tempplan {
    struct tempplan_params p;
    double *loss_w, *capacity_j_k, *core_share;
    int degrees, cores;
    struct deposit_map map;
    struct layer_clock clock;
    double weighed_z_mm, z_weight;          /* how much path at the newest height counts in that: */
    double usual_c, usual_mm;               /* interface by the user's own temperature, averaged over this path */
    struct tempplan_piece *pieces;          /* those of the future and of the part planned but not yet deposited */
    double *shares;                         /* of each, tempplan_melt_share() of its flow */
    int count, room;
    struct best_path path;
    struct tempplan_point *points;
    int point_count, point_room, line_from;     /* points from here on are those of the newest plan */
    struct tempplan_point *corners;         /* by which the nozzle is led: of the points, those that matter */
    int corner_count, corner_room;
    double holder_c, holder_from_s;         /* nozzle temperature at which the holder would be in balance, and when */
    struct tempplan_report report;
    int min_bin, max_bin;                /* of report.substrate_mm, between which there is anything */
};

/* Of the nozzle (thermal/models/melt_exchange.py). Part of the way from inlet to wall that the melt goes. */
double tempplan_melt_share(const struct tempplan_params *p, double flow_mm3_s);
/* From a change of the nozzle to that of the melt. */
double tempplan_lag_s(const struct tempplan_params *p, double flow_mm3_s);
/* Wall that makes this melt at a flow of this share: whether or not the nozzle may be so, and within its limits. */
double tempplan_free_wall_c(const struct tempplan *tp, double melt_c, double flow_mm3_s, double share);
double tempplan_wall_for(const struct tempplan *tp, double melt_c, double flow_mm3_s, double share);

#endif
