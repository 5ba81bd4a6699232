#ifndef FERRITE_TEMPPLAN_PATH_H
#define FERRITE_TEMPPLAN_PATH_H
/*
 * Planned moves to pieces of path for the temperature plan: split, with flow and layer height.
 *
 *   look-ahead ─► note: copied when their times are fixed ─► run: pieces at one extrusion rate each ─► tempplan_add
 *                                                            (take: both)
 *
 * Nothing is worked out while the look-ahead waits; `run` comes later, in the plan's own timer. mm, s, degC.
 */
#include "planner.h"

struct lookahead;
struct model_line;
struct tempplan_path;

struct path_move {
    double start_s, accel_s, cruise_s, decel_s, start_v, cruise_v, end_v, distance_mm;
    double start_pos[3], end_pos[3];
    double filament_mm;             /* deposited on the way; 0: nothing is, or the extruder moves alone */
    double fan;
};

/* What is asked for by name, true for moves that begin before until_s. by_place: it depends on the layer, too. */
struct path_request {
    double until_s, by_place, request_c, base_c, height_mm /* NaN: not given */, speed_factor;
};

struct path_facts {
    double next_s, end_s;           /* start of the first move that waits and end of the last; next NaN: none waits */
    double layer, z_mm, height_mm;  /* newest layer; counted from 1 */
    double waiting, deposited;           /* moves that wait; pieces with extrusion so far */
};

struct path_turn {
    double end_s;                   /* of what is planned */
    int count;                      /* corners (tempplan_make); more than `room`: they are not in the line */
};

/* NULL: no memory. Pieces are no longer than longest_mm. */
struct tempplan_path *tempplan_path_alloc(double filament_mm2, double longest_mm);
void tempplan_path_free(struct tempplan_path *path);
/* The first moves of the look-ahead's row, which are planned, in order; the first begins at print_time. Plans are made up
 * to planned_s: 1 if enough moves wait now for another plan, or if these begin a new stretch; -1: no memory. */
int tempplan_path_note_planned(struct tempplan_path *path, const struct lookahead *la, int count, double print_time,
                               double fan, double planned_s);
/* Pieces of the moves that wait, as far as `request` is true for them: up to until_s, and, if it goes by place, up to the
 * first of another layer, which facts() then have. Returns how many, or -1: no memory. *pieces is good until the next
 * call. */
int tempplan_path_run(struct tempplan_path *path, const struct path_request *request, struct tempplan_piece **pieces);
/* run and tempplan_add. Returns how many moves still wait, or -1: no memory. */
int tempplan_path_take(struct tempplan_path *path, const struct path_request *request, struct tempplan *tp);
/* All of a timer's turn at once: take what waits as far as `request` is true, record what lies before recorded_s, and plan again
 * from from_s on, where the nozzle is led now. Returns how many moves still wait (other requests hold for them: nothing is
 * planned yet), or -1: no memory. `line` has room for `room` corners. */
int tempplan_path_turn(struct tempplan_path *path, const struct path_request *request, struct tempplan *tp, double from_s,
                       double within_c, double recorded_s, struct path_turn *turn, struct model_line *line, int room);
/* Forget what ends before until_s. */
void tempplan_path_drop(struct tempplan_path *path, double until_s);
void tempplan_path_facts(const struct tempplan_path *path, struct path_facts *facts);

#endif
