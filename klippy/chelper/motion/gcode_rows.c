/* Rows of plain G0/G1 lines: see gcode_rows.h. */
#include "gcode_rows.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "lookahead.h"

enum { WORD_X, WORD_Y, WORD_Z, WORD_E, WORD_F, WORD_COUNT };
/* Decimal numbers of up to this many digits are exact: digits and power of ten both fit a double, so that the
 * one division rounds correctly (David Gay, "Correctly rounded binary-decimal conversions", 1990). */
enum { EXACT_DIGITS = 15 };
#define MM_PER_MIN (1. / 60.)

/* Parse [+-]digits[.digits]; returns what follows, NULL if it is written in any other way. */
/* As motionlimits.py: the lowest speed of a move. */
#define MIN_SPEED_MM_S 1e-3

static const char *
parse_number(const char *p, double *value)
{
    static const double power_of_ten[EXACT_DIGITS + 1] = {
        1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15,
    };
    int negative = *p == '-', digits = 0, decimals = 0, point = 0;
    int64_t number = 0;
    if (*p == '-' || *p == '+')
        p++;
    for (;; p++) {
        if (*p >= '0' && *p <= '9') {
            if (++digits > EXACT_DIGITS)
                return NULL;
            number = number * 10 + (*p - '0');
            decimals += point;
        } else if (*p == '.' && !point) {
            point = 1;
        } else {
            break;
        }
    }
    if (!digits)
        return NULL;
    double magnitude = (double)number / power_of_ten[decimals];
    *value = negative ? -magnitude : magnitude;
    return p;
}

static int
word_of(char letter)
{
    switch (letter) {
    case 'X': return WORD_X;
    case 'Y': return WORD_Y;
    case 'Z': return WORD_Z;
    case 'E': return WORD_E;
    case 'F': return WORD_F;
    default: return -1;
    }
}

/* Is p at the end of a command: line end, or a comment? */
static int
at_end(const char *p)
{
    return *p == '\n' || *p == ';' || (*p == '\r' && p[1] == '\n');
}

/* Parse "G0 ..." or "G1 ..." in its plain form: words X Y Z E F, each at most once, upper case. */
static int
parse_line(const char *p, struct gcode_words *words)
{
    words->given = 0;
    if (p[0] != 'G' || (p[1] != '0' && p[1] != '1') || p[2] != ' ')
        return 0;
    for (p += 2;;) {
        while (*p == ' ')
            p++;
        if (at_end(p))
            return words->given != 0;
        int word = word_of(*p);
        if (word < 0 || (words->given >> word & 1))
            return 0;
        words->given |= 1u << word;
        p = parse_number(p + 1, &words->value[word]);
        if (!p || (*p != ' ' && !at_end(p) && word_of(*p) < 0))
            return 0;
    }
}

/* A path_sink: queue one move of the toolhead; 0 if it must not be. */
static int
queue_move(void *context, const double *target, double speed)
{
    struct row_state *s = context;
    struct lookahead *la = s->lookahead;
    struct lookahead_move move;
    move_fill(&move, &s->limits, s->commanded, target, speed, 0.);
    if (move.move_d == 0.)
        return 1;
    if (s->due != 0.)                   /* in the middle of a line: it is for Python to plan there */
        return 0;
    if (move.is_kinematic_move != 0. && !move_check_box(&move, &s->box))
        return 0;
    if (move.axes_d[3] != 0. && move_check_filament(&move, &s->filament) != FILAMENT_OK)
        return 0;
    double filament_v2 = move.max_cruise_v2;
    if (la->next != la->first)
        filament_v2 = move_filament_v2(lookahead_move_at(la, la->next - 1), &move, s->filament.instant_corner_v);
    memcpy(s->commanded, move.end_pos, sizeof(s->commanded));
    s->due = lookahead_add(la, &move, filament_v2);
    s->queued += 1.;
    return 1;
}

void
gcode_destination(const struct gcode_modes *modes, const struct gcode_words *words, struct gcode_destination *dest)
{
    const double *last = modes->last;
    double *target = dest->target;
    for (int i = 0; i < 4; i++) {
        target[i] = last[i];
        if (!(words->given >> i & 1))
            continue;
        double value = i == WORD_E ? words->value[i] * modes->extrude_factor : words->value[i];
        int absolute = modes->absolute_coord != 0. && (i != WORD_E || modes->absolute_extrude != 0.);
        target[i] = value + (absolute ? modes->base[i] : target[i]);
    }
    dest->modal_speed = words->given >> WORD_F & 1 ? words->value[WORD_F] * MM_PER_MIN : modes->speed;
    double factor = modes->speed_factor;
    if (modes->plan_speed_factor != 1. && target[3] > last[3] && (target[0] != last[0] || target[1] != last[1]))
        factor *= modes->plan_speed_factor;
    dest->speed = dest->modal_speed * factor;
}

/* Carry out one G0/G1; 0, with nothing changed, if that is for Python to do. */
static int
run_words(struct row_state *s, const struct gcode_words *words)
{
    struct gcode_destination dest;
    gcode_destination(&s->modes, words, &dest);
    const double *target = dest.target;
    if (!(dest.modal_speed > 0.) || !(dest.speed >= MIN_SPEED_MM_S)
        || !isfinite(target[0] + target[1] + target[2] + target[3] + dest.modal_speed))
        return 0;
    const struct row_state before = *s;
    const struct lookahead queue_before = *s->lookahead;
    if (!path_move(s->path, target, dest.speed, queue_move, s)) {        /* perhaps after a part of it */
        *s = before;
        s->lookahead->next = queue_before.next;
        s->lookahead->until_review_s = queue_before.until_review_s;
        return 0;
    }
    memcpy(s->modes.last, target, sizeof(s->modes.last));
    s->modes.speed = dest.modal_speed;
    return 1;
}

int
rows_run(struct row_state *s, const char *text, int len)
{
    int done = 0;
    s->due = s->queued = 0.;
    while (done < len && s->due == 0.) {
        const char *line = text + done, *p = line;
        const char *end = memchr(line, '\n', (size_t)(len - done));
        struct gcode_words words;
        if (!end)
            break;
        while (*p == ' ')
            p++;
        if (*p == ';' && s->wants_comments != 0.)
            break;
        if (!at_end(p) && (!parse_line(line, &words) || !run_words(s, &words)))
            break;
        done = (int)(end + 1 - text);
    }
    return done;
}

static void
widen(struct rows_span *span, const struct gcode_words *words)
{
    for (int axis = 0; axis < 3; axis++) {
        const double value = words->value[axis];
        if (!(words->given >> axis & 1))
            continue;
        const int first = !(span->given >> axis & 1);
        span->low[axis] = first ? value : fmin(span->low[axis], value);
        span->high[axis] = first ? value : fmax(span->high[axis], value);
        span->last[axis] = value;
        span->given |= 1u << axis;
    }
    span->moves++;
}

int
rows_span(struct rows_span *span, const char *text, int len)
{
    int done = 0;
    *span = (struct rows_span){ .lines = 0 };
    while (done < len) {
        const char *line = text + done, *p = line;
        const char *end = memchr(line, '\n', (size_t)(len - done));
        struct gcode_words words = { .given = 0 };
        if (!end)
            break;
        while (*p == ' ')
            p++;
        if (!at_end(p)) {
            if (!parse_line(line, &words))
                break;
            widen(span, &words);
        }
        span->lines++;
        done = (int)(end + 1 - text);
    }
    return done;
}
