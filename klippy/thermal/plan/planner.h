#ifndef FERRITE_TEMPPLAN_H
#define FERRITE_TEMPPLAN_H
/*
 * The temperature plan: pieces of planned path in, a nozzle temperature over time out.
 *
 *   piece ─► deposit map: what lies there, how warm ─► wanted melt ─► wanted wall ─► ramps that physics can follow
 *            (thermal/plan/deposit.py)                      (this file)    (thermal/models/melt_exchange.py)  (thermal/plan/set_points.py)
 *
 * The Python modules named are the readable reference, with the equations and their sources; the tests hold this file
 * to them. Two histories of the part are kept side by side: [0] as planned, [1] as one fixed temperature would have
 * deposited it. Times are print times in s, lengths mm, temperatures degC.
 */
#include <stdint.h>

enum { TEMPPLAN_HISTORIES = 2, TEMPPLAN_BINS = 600 };

struct tempplan_params {
    /* limits of the nozzle; losses and capacity come as tables per whole degree */
    double floor_c, ceiling_c, power_w, holder_w_k, holder_s;
    double ua_w_k, heat_mj_m3k, inlet_c, bore_lag_s, melt_mm3;
    /* material: window of the melt, diffusivity m2/s, rho c in J/(m3 K) */
    double low_c, high_c, diffusivity_m2_s, rho_c, bonding_c;
    /* surroundings (thermal/plan/deposit.py) */
    double bed_c, chamber_c, still_w_m2k, fan_w_m2k, bed_reach_mm, cell_mm;
    double interface_c;             /* wanted at the weld; NaN: bonding has no say */
    double follow_mm;               /* > 0: at least interface_c, and what the user's own temperature gives on average
                                     * over this path */
    double core_c;                  /* the filament's core must reach it; NaN: no say */
    double core_step_mm3_s;         /* flow per entry of the core table */
    /* Wanted walls are averaged over this time to both sides, by volume. Heating is ten times as quick as cooling:
     * a plan that went after every corner's flow would ratchet up. 0: not averaged. */
    double smooth_s;
    double preview;                 /* 0: turn at the border of each piece, as M104 would; for comparing */
};

/* Doubles only: Python packs rows of them in one go. */
struct tempplan_piece {
    double start_s, end_s;
    double start_pos[3], end_pos[3];
    double flow_mm3_s, height_mm, fan;
    double request_c;               /* melt temperature asked for by name, NaN: none, bonding may choose */
    double base_c;                  /* nozzle temperature of the user's own target */
    double speed_factor;            /* part of its own speed at which it is deposited, 1: not slowed down */
    /* filled in */
    double substrate_c[TEMPPLAN_HISTORIES], melt_c, wall_c;
    double wanted_c;                /* wall for the weld alone, whatever material and nozzle bear */
};

struct tempplan_point {
    double time_s, temp_c;
};

/* What has been deposited so far; lengths mm of path with extrusion. */
struct tempplan_report {
    double length_mm, bonded_mm[TEMPPLAN_HISTORIES];
    double interface_mm[TEMPPLAN_HISTORIES][TEMPPLAN_BINS];  /* length by interface temperature, whole degrees */
    /* Added, not yet deposited: its length, and by temperature of what it meets, whole degrees. */
    double added_mm, substrate_mm[TEMPPLAN_BINS];
    double lowest_c, highest_c;         /* interface that the window can make of its hottest and of its coldest 5 % */
    double off_sum, off_squares;    /* planned less wanted melt, length weighted */
    double cold_mm;                 /* wanted melt was above the window's top: the substrate was too cold */
    double hot_mm;                  /* below its bottom: too hot even for the coolest melt */
    /* Path deposited on a layer below, and sums over it (times mm): how long ago that was deposited; of this, extrusion;
     * the same extrusion at full speed; open flanks per volume, 1/mm. Counted when added, not when deposited. */
    double above_mm, age_s, depositing_s, full_speed_s, side_per_mm;
    double slowed_s;                /* that all extrusion so far takes longer than at full speed */
    uint64_t pieces;
};

struct tempplan;
/* loss_w and capacity_j_k: `degrees` entries from 0 degC; core_share: `cores` entries, flow in steps. NULL: no memory. */
struct tempplan *tempplan_alloc(const struct tempplan_params *params, const double *loss_w, const double *capacity_j_k,
                                int degrees, const double *core_share, int cores);
void tempplan_free(struct tempplan *tp);
/* Other parameters from now on (material, bed); what has been deposited stays. */
void tempplan_set(struct tempplan *tp, const struct tempplan_params *params);
/* Pieces in order of time, after all added before. Fills in their results; 0, or -1: no memory (nothing added). */
int tempplan_add(struct tempplan *tp, struct tempplan_piece *pieces, int count);
/* Plan again from from_s on, where the nozzle is asked to be at start_c. The nozzle is led from then on by the plan's
 * corners, without those that lie within within_c of a line between others; some of the last half second are kept (a
 * controller looks back). Returns how many, 0: nothing lies ahead (or start_c is not known, or there is no memory), all is as
 * before. */
int tempplan_make(struct tempplan *tp, double from_s, double start_c, double within_c);
/* From the first of these on the nozzle is led by them instead (back to the user's target, or by the user). 0, or -1: no
 * memory. */
int tempplan_lead(struct tempplan *tp, const struct tempplan_point *points, int count);
/* The corners by which the nozzle is led, good until the next plan; and its temperature by them, NaN: none. */
const struct tempplan_point *tempplan_corners(const struct tempplan *tp);
double tempplan_led(const struct tempplan *tp, double time_s);
/* Nozzle temperature at which its holder is in balance then, where the nozzle is at nozzle_c. In order of time. */
double tempplan_holder(struct tempplan *tp, double time_s, double nozzle_c);
double tempplan_at(const struct tempplan *tp, double time_s, double otherwise_c);
/* Melt temperature wanted then; NaN: no extrusion is planned, or it is recorded already. */
double tempplan_melt_at(const struct tempplan *tp, double time_s);
/* Pieces that end before until_s have been deposited: record them and let them go. Returns the rows of `done`, if given. */
int tempplan_finish(struct tempplan *tp, double until_s, double *done, int capacity);
/* The user's own target moves by delta_c: what is not asked for by name from from_s on moves with it, and so does the
 * interface that the plan follows. */
void tempplan_shift(struct tempplan *tp, double from_s, double delta_c);
/* The interface wanted where nothing is asked for by name; NaN: bonding has no say. */
double tempplan_interface(const struct tempplan *tp);
/* The one for which hot layers are slowed down. A found interface is meant for what comes away from the bed. Near the
 * bed, whose warmth no waiting takes away, a layer has time for what the hottest melt makes of the coldest path. */
double tempplan_speed_interface(const struct tempplan *tp);
/* Forget what lies ahead of time_s (a stop); what has been deposited stays. */
void tempplan_cut(struct tempplan *tp, double time_s);
const struct tempplan_report *tempplan_report(const struct tempplan *tp);
/* {cells of the map, pieces held}: what memory goes with. */
void tempplan_sizes(const struct tempplan *tp, uint64_t sizes[2]);

#endif
