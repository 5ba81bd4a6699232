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
/* As lookahead.py: acceleration of moves of the extruder alone, least length of a motion, equal filament ratios. */
#define UNLIMITED_ACCEL 99999999.9
#define MIN_DISTANCE_MM 1e-9
#define SAME_RATIO 1e-9
#define MM_PER_MIN (1. / 60.)

struct words {
    double value[WORD_COUNT];
    unsigned int given;             /* bit per word */
};

/* Parse [+-]digits[.digits]; returns what follows, NULL if it is written in any other way. */
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
parse_line(const char *p, struct words *words)
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

/* Geometry and machine limits of a move from `start` to `end`; as Move in lookahead.py. */
static void
fill_move(const struct row_state *s, const double *end, double speed, struct lookahead_move *m)
{
    double dx = end[0] - s->commanded[0], dy = end[1] - s->commanded[1], dz = end[2] - s->commanded[2];
    double de = end[3] - s->commanded[3], inverse;
    memcpy(m->start_pos, s->commanded, sizeof(m->start_pos));
    memcpy(m->end_pos, end, sizeof(m->end_pos));
    m->accel = s->max_accel;
    m->junction_deviation = s->junction_deviation;
    m->move_d = sqrt(dx * dx + dy * dy + dz * dz);
    m->is_kinematic_move = m->move_d >= MIN_DISTANCE_MM;
    if (m->is_kinematic_move != 0.) {
        if (speed > s->max_velocity)
            speed = s->max_velocity;
        inverse = 1. / m->move_d;
    } else {
        memcpy(m->end_pos, s->commanded, 3 * sizeof(double));
        dx = dy = dz = 0.;
        m->move_d = fabs(de);
        m->accel = UNLIMITED_ACCEL;
        inverse = m->move_d != 0. ? 1. / m->move_d : 0.;
    }
    const double d[4] = { dx, dy, dz, de };
    for (int i = 0; i < 4; i++) {
        m->axes_d[i] = d[i];
        m->axes_r[i] = d[i] * inverse;
    }
    m->min_move_t = m->move_d / speed;
    m->max_cruise_v2 = speed * speed;
    m->delta_v2 = 2. * m->move_d * m->accel;
    m->smooth_delta_v2 = 2. * m->move_d * s->max_accel_to_decel;
}

static void
limit_speed(struct lookahead_move *m, double speed, double accel)
{
    double speed2 = speed * speed;
    if (speed2 < m->max_cruise_v2) {
        m->max_cruise_v2 = speed2;
        m->min_move_t = m->move_d / speed;
    }
    if (accel < m->accel)
        m->accel = accel;
    m->delta_v2 = 2. * m->move_d * m->accel;
    if (m->smooth_delta_v2 > m->delta_v2)
        m->smooth_delta_v2 = m->delta_v2;
}

/* Inside the box? Slows the move down if z limits it. */
static int
check_box(const struct row_state *s, struct lookahead_move *m)
{
    for (int i = 0; i < 2; i++)
        if (!(s->box_min[i] <= m->end_pos[i] && m->end_pos[i] <= s->box_max[i]))
            return 0;
    double dz = m->axes_d[2];
    if (dz == 0.)
        return 1;
    if (!(s->box_min[2] <= m->end_pos[2] && m->end_pos[2] <= s->box_max[2]))
        return 0;
    double stretch = m->move_d / fabs(dz);
    limit_speed(m, s->max_z_velocity * stretch, s->max_z_accel * stretch);
    return 1;
}

/* May the filament move so? Slows down moves of the extruder alone. */
static int
check_extruder(const struct row_state *s, struct lookahead_move *m)
{
    double extrude_d = m->axes_d[3], ratio = m->axes_r[3];
    if (s->can_extrude == 0.)
        return 0;
    if ((m->axes_d[0] == 0. && m->axes_d[1] == 0.) || ratio < 0.) {
        if (fabs(extrude_d) > s->max_e_dist)
            return 0;
        double per_ratio = 1. / fabs(ratio);
        limit_speed(m, s->max_e_velocity * per_ratio, s->max_e_accel * per_ratio);
        return 1;
    }
    return !(ratio > s->max_extrude_ratio && extrude_d > s->nozzle_diameter * s->max_extrude_ratio);
}

/* The extruder's own limit for the junction: its speed may jump by instant_corner_v at most. */
static double
extruder_v2(const struct row_state *s, const struct lookahead *la, const struct lookahead_move *m)
{
    if (la->next == la->first || s->can_extrude == 0.)
        return m->max_cruise_v2;
    double change = m->axes_r[3] - lookahead_move_at(la, la->next - 1)->axes_r[3];
    if (-SAME_RATIO < change && change < SAME_RATIO)
        return m->max_cruise_v2;
    double v = s->instant_corner_v / change;
    return v * v;
}

/* Carry out one G0/G1; 0, with nothing changed, if that is for Python to do. */
static int
run_words(struct row_state *s, struct lookahead *la, const struct words *w)
{
    double target[4], speed = s->speed;
    for (int i = 0; i < 4; i++) {
        target[i] = s->last[i];
        if (!(w->given >> i & 1))
            continue;
        double value = i == WORD_E ? w->value[i] * s->extrude_factor : w->value[i];
        int absolute = s->absolute_coord != 0. && (i != WORD_E || s->absolute_extrude != 0.);
        target[i] = value + (absolute ? s->base[i] : target[i]);
    }
    if (w->given >> WORD_F & 1)
        speed = w->value[WORD_F] * MM_PER_MIN;
    double factor = s->speed_factor;
    if (s->pace != 1. && target[3] > s->last[3] && (target[0] != s->last[0] || target[1] != s->last[1]))
        factor *= s->pace;
    double effective = speed * factor;
    if (!(speed > 0.) || !(effective > 0.) || !isfinite(target[0] + target[1] + target[2] + target[3] + speed))
        return 0;
    struct lookahead_move move = { .move_d = 0. };
    fill_move(s, target, effective, &move);
    if (move.move_d != 0.) {
        if (move.is_kinematic_move != 0. && !check_box(s, &move))
            return 0;
        if (move.axes_d[3] != 0. && !check_extruder(s, &move))
            return 0;
        memcpy(s->commanded, move.end_pos, sizeof(s->commanded));
        s->due = lookahead_add(la, &move, extruder_v2(s, la, &move));
        s->queued += 1.;
    }
    memcpy(s->last, target, sizeof(s->last));
    s->speed = speed;
    return 1;
}

int
rows_run(struct row_state *s, struct lookahead *la, const char *text, int len)
{
    int done = 0;
    s->due = s->queued = 0.;
    while (done < len && s->due == 0.) {
        const char *line = text + done, *p = line;
        const char *end = memchr(line, '\n', (size_t)(len - done));
        struct words words;
        if (!end)
            break;
        while (*p == ' ')
            p++;
        if (*p == ';' && s->wants_comments != 0.)
            break;
        if (!at_end(p) && (!parse_line(line, &words) || !run_words(s, la, &words)))
            break;
        done = (int)(end + 1 - text);
    }
    return done;
}
