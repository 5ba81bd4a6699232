#ifndef FERRITE_PATH_STAGE_H
#define FERRITE_PATH_STAGE_H
/*
 * What may stand between G-code and toolhead and change where a move goes: a row of stages.
 *
 *      G-code -> stage -> stage -> ... -> toolhead        each hands on one move, a mesh as many as the bed asks for
 *
 * The transforms themselves are Python's (bed_mesh, skew_correction, exclude_object): they fill in a stage before a
 * row of lines, take over what has changed in it afterwards, and run single lines by the same functions. mm.
 */

/* The shape of the bed and how it is followed: klippy/extras/probing/surface_fit.py. */
struct bed_surface {
    const double *heights;          /* row by row along x */
    int columns, rows;
    double low[2], per_mm[2];       /* first place of the grid, spacings per mm */
    double shift[3];                /* added to x, y and, for the fade, z before looking up */
    double fade_start, fade_end, fade_target;
    double check_distance;          /* of places on a path */
    double max_change;             /* of the correction without a corner */
};

/* Goes through the corrected corners of one straight move. */
struct bed_walk {
    const struct bed_surface *bed;
    double start[4], end[4], length, last;
    double share;                   /* of the move that has been handed out */
    int number, pieces, is_done;
};

enum path_kind { PATH_SHIFT, PATH_SKEW, PATH_BED };

struct path_stage {
    int kind;
    struct path_stage *next;        /* NULL: the toolhead */
    double last[4];                 /* where the newest move handed to it ends */
    double peak_e;                  /* farthest position of the filament among those ends */
    double left_out_e;              /* PATH_SHIFT: taken off the filament's position */
    double skew_xy, skew_xz, skew_yz;
    const struct bed_surface *bed;
};

/* Takes the corners of a move; 0 refuses it. */
typedef int (*path_sink)(void *context, const double *place, double speed);

/* Height of the bed, beyond the edges as at the edges. */
double bed_height(const struct bed_surface *bed, double x, double y);
/* What is added to z over a place of that height. */
double bed_faded(const struct bed_surface *bed, double z, double height);
void bed_walk_begin(struct bed_walk *walk, const struct bed_surface *bed, const double *start, const double *end);
/* The next corner; 0 after the last, which is the end. */
int bed_walk_next(struct bed_walk *walk, double *corner);
/* What to command to a machine with these skews to reach a place. */
void path_unskew(const struct path_stage *stage, const double *place, double *commanded);
/* Hand a move through the stages to the sink; 0 if it refused. */
int path_move(struct path_stage *stage, const double *target, double speed, path_sink sink, void *context);

#endif
