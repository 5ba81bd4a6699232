/* Stages between G-code and toolhead: see path_stage.h. */
#include "path_stage.h"

#include <math.h>
#include <string.h>

static double
clamp(double value, double high)
{
    return value < 0. ? 0. : value > high ? high : value;
}

double
bed_height(const struct bed_surface *bed, double x, double y)
{
    double u = clamp((x - bed->low[0]) * bed->per_mm[0], bed->columns - 1.);
    double v = clamp((y - bed->low[1]) * bed->per_mm[1], bed->rows - 1.);
    int column = (int)u, row = (int)v;
    if (column > bed->columns - 2)
        column = bed->columns - 2;
    if (row > bed->rows - 2)
        row = bed->rows - 2;
    u -= column;
    v -= row;
    const double *front = bed->heights + row * bed->columns + column, *back = front + bed->columns;
    double near = front[0] + u * (front[1] - front[0]);
    double far = back[0] + u * (back[1] - back[0]);
    return near + v * (far - near);
}

double
bed_faded(const struct bed_surface *bed, double z, double height)
{
    double share = 1.;
    if (z > bed->fade_start)
        share = fmax(0., (bed->fade_end - z) / (bed->fade_end - bed->fade_start));
    return bed->fade_target + share * (height - bed->fade_target);
}

static double
correction(const struct bed_surface *bed, const double *place)
{
    double height = bed_height(bed, place[0] + bed->shift[0], place[1] + bed->shift[1]);
    return bed_faded(bed, place[2] + bed->shift[2], height);
}

void
bed_walk_begin(struct bed_walk *walk, const struct bed_surface *bed, const double *start, const double *end)
{
    walk->bed = bed;
    memcpy(walk->start, start, sizeof(walk->start));
    memcpy(walk->end, end, sizeof(walk->end));
    walk->length = hypot(end[0] - start[0], end[1] - start[1]);
    walk->pieces = (int)ceil(walk->length / bed->check_distance);
    walk->last = walk->pieces > 1 ? correction(bed, start) : 0.;
    walk->number = 1;
    walk->share = 0.;
    walk->is_done = 0;
}

int
bed_walk_next(struct bed_walk *walk, double *corner)
{
    for (; walk->number < walk->pieces; walk->number++) {
        walk->share = walk->number * walk->bed->check_distance / walk->length;
        for (int i = 0; i < 4; i++)
            corner[i] = walk->start[i] + walk->share * (walk->end[i] - walk->start[i]);
        double change = correction(walk->bed, corner);
        if (fabs(change - walk->last) < walk->bed->max_change)
            continue;
        walk->last = change;
        walk->number++;
        corner[2] += change;
        return 1;
    }
    if (walk->is_done)
        return 0;
    walk->is_done = 1;
    walk->share = 1.;
    memcpy(corner, walk->end, sizeof(walk->end));
    corner[2] += correction(walk->bed, walk->end);
    return 1;
}

void
path_unskew(const struct path_stage *stage, const double *place, double *commanded)
{
    double y = place[1] - stage->skew_yz * place[2];
    commanded[0] = place[0] - stage->skew_xy * y - stage->skew_xz * place[2];
    commanded[1] = y;
    commanded[2] = place[2];
    commanded[3] = place[3];
}

static int
follow_bed(struct path_stage *stage, const double *target, double speed, path_sink sink, void *context)
{
    struct bed_walk walk;
    double corner[4];
    bed_walk_begin(&walk, stage->bed, stage->last, target);
    while (bed_walk_next(&walk, corner))
        if (!path_move(stage->next, corner, speed, sink, context))
            return 0;
    return 1;
}

int
path_move(struct path_stage *stage, const double *target, double speed, path_sink sink, void *context)
{
    double place[4];
    int taken;
    if (!stage)
        return sink(context, target, speed);
    if (stage->kind == PATH_BED) {
        taken = follow_bed(stage, target, speed, sink, context);
    } else {
        memcpy(place, target, sizeof(place));
        if (stage->kind == PATH_SKEW)
            path_unskew(stage, target, place);
        else
            place[3] -= stage->left_out_e;
        taken = path_move(stage->next, place, speed, sink, context);
    }
    if (taken) {
        memcpy(stage->last, target, sizeof(stage->last));
        stage->peak_e = fmax(stage->peak_e, target[3]);
    }
    return taken;
}
