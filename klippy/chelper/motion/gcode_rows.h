#ifndef FERRITE_GCODE_ROWS_H
#define FERRITE_GCODE_ROWS_H
/*
 * The short way of plain G0/G1 lines: text -> modal state -> checked move -> look-ahead queue.
 *
 * Only what needs no one's attention is done here. A line that is written in an unusual way, leaves the machine's
 * box, breaks a limit or is no G0/G1 is left alone, whole, for the Python path, which does the same sums in the
 * same order and knows the error texts.
 */
#include "move.h"

struct lookahead;

/* Doubles only: Python packs it in one go; the first 13 come back. mm, mm/s, mm/s^2. */
struct row_state {
    double last[4];                 /* of G-code, in toolhead coordinates */
    double commanded[4];            /* of the toolhead */
    double speed;                   /* of G-code, before speed_factor */
    double due;                     /* out: 1 if it is time to plan */
    double queued;                  /* out: moves queued */
    double wants_comments;          /* lines that are only a comment are left to Python */
    double base[4], speed_factor, pace, extrude_factor, absolute_coord, absolute_extrude;
    struct move_limits limits;
    struct axis_box box;
    struct filament_limits filament;
};

/* Runs lines of text[0..len) from the front, until one is left to Python, no whole line remains, or planning is
 * due. Returns how many characters are done with; always ends behind a line end. */
int rows_run(struct row_state *state, struct lookahead *la, const char *text, int len);

#endif
