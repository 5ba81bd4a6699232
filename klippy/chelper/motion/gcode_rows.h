#ifndef FERRITE_GCODE_ROWS_H
#define FERRITE_GCODE_ROWS_H
/*
 * Rows of plain G0/G1 lines: text -> modal state -> stages between G-code and toolhead -> checked moves -> look-ahead.
 *
 * Only plain lines are run here. A line that is written in an unusual way, leaves the machine's box, breaks a limit
 * or is no G0/G1 is left whole for Python. Python reads any line, knows the error texts, and otherwise calls the
 * same functions (gcode_destination, path_stage.h, move.h). mm, mm/s, mm/s^2.
 */
#include "move.h"
#include "path_stage.h"

struct lookahead;

/* Doubles only: Python packs them in one go. Positions are in toolhead coordinates. */
struct gcode_modes {
    double last[4], speed;                         /* after the last line; before the factors */
    double base[4], speed_factor, plan_speed_factor, extrude_factor, absolute_coord, absolute_extrude;
};
/* What a line says: X, Y, Z, E and F. */
struct gcode_words {
    double value[5];
    unsigned int given;             /* bit per word */
};
/* Where it leads: speed with the factors, and as it stays. */
struct gcode_destination {
    double target[4], modal_speed, speed;
};
/* Doubles first: Python packs them in one go. */
struct row_state {
    struct gcode_modes modes;
    double commanded[4];                    /* of the toolhead */
    double due, queued;                     /* out: 1 if it is time to plan; moves queued */
    double wants_comments;                  /* lines that are only a comment are left to Python */
    struct move_limits limits;
    struct axis_box box;
    struct filament_limits filament;
    struct path_stage *path;              /* the first stage; NULL: the toolhead */
    struct lookahead *lookahead;
};

void gcode_destination(const struct gcode_modes *modes, const struct gcode_words *words, struct gcode_destination *dest);
/* Runs lines of text[0..len) from the front, until one is left to Python, no whole line remains, or planning is
 * due. Returns how many characters are done with; always ends behind a line end. */
int rows_run(struct row_state *state, const char *text, int len);

/* What rows of plain lines say of X, Y and Z: lowest, highest and last value as written. */
struct rows_span {
    double low[3], high[3], last[3];
    unsigned int given;             /* bit per axis */
    int lines, moves;
};
/* Reads text[0..len) up to a line that is no plain move, comment or empty one. Returns how many characters are done with;
 * always ends behind a line end. */
int rows_span(struct rows_span *span, const char *text, int len);

#endif
