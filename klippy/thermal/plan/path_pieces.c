/* Planned moves to pieces of path; see path_pieces.h. */
#include "path_pieces.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "chelper/motion/lookahead.h"
#include "thermal/control/reference_line.h"

static const double HEIGHT_MIN_MM = 0.05, HEIGHT_MAX_MM = 1.0;
static const double HEIGHT_FIRST_MM = 0.2;  /* until a second layer shows it */
static const double SAME_Z_MM = 1e-3, TINY_S = 1e-6;
/* New motion is worth another plan at this time and this many moves, or at twice this time. */
static const double REPLAN_S = 0.5;
static const int REPLAN_MOVES = 16;
static const double GAP_S = 0.2;            /* after this rest another stretch begins */
/* A shorter move is one piece: the filament's compliance (20 ms) blurs its phases. */
static const double PHASE_MIN_S = 0.015;

enum { PHASES = 3 };

struct tempplan_path {
    double filament_mm2, longest_mm;
    struct path_move *moves;
    int first, count, room;                 /* those that wait: moves[first .. first + count - 1] */
    struct tempplan_piece *pieces;
    int piece_count, piece_room;
    double end_s, z_mm, height_mm, layer, deposited;
};

/* Part of a move at about one speed. */
struct phase {
    double duration_s, share;               /* of the way */
};

struct tempplan_path *tempplan_path_alloc(double filament_mm2, double longest_mm)
{
    struct tempplan_path *path = calloc(1, sizeof(*path));
    if (path) {
        path->filament_mm2 = filament_mm2;
        path->longest_mm = longest_mm;
        path->z_mm = NAN;
        path->height_mm = HEIGHT_FIRST_MM;
        path->end_s = -INFINITY;
    }
    return path;
}

void tempplan_path_free(struct tempplan_path *path)
{
    if (!path)
        return;
    free(path->moves);
    free(path->pieces);
    free(path);
}

/* -- moves that wait -- */

static int reserve(struct tempplan_path *path, int more)
{
    if (path->first + path->count + more <= path->room)
        return 0;
    if (path->first) {
        memmove(path->moves, path->moves + path->first, path->count * sizeof(*path->moves));
        path->first = 0;
    }
    int room = path->room ? path->room : 256;
    while (room < path->count + more)
        room *= 2;
    if (room == path->room)
        return 0;
    struct path_move *moves = realloc(path->moves, room * sizeof(*moves));
    if (!moves)
        return -1;
    path->moves = moves;
    path->room = room;
    return 0;
}

static double duration_s(const struct path_move *m)
{
    return m->accel_s + m->cruise_s + m->decel_s;
}

static void append(struct tempplan_path *path, const struct path_move *m)
{
    if (duration_s(m) <= TINY_S)
        return;
    path->moves[path->first + path->count++] = *m;
    path->end_s = m->start_s + duration_s(m);
}

static int is_due(const struct tempplan_path *path, double planned_s)
{
    double news_s = path->end_s - planned_s;
    return news_s >= REPLAN_S && (path->count >= REPLAN_MOVES || news_s >= 2.0 * REPLAN_S);
}

int tempplan_path_note_planned(struct tempplan_path *path, const struct lookahead *la, int count, double print_time,
                               double fan, double planned_s)
{
    if (reserve(path, count))
        return -1;
    int starts = !path->count && print_time > planned_s + GAP_S;
    for (int i = 0; i < count; i++) {
        const struct lookahead_move *q = lookahead_move_at(la, la->first + i);
        int deposits = q->is_kinematic_move != 0.0 && q->axes_d[3] > 0.0 && (q->axes_d[0] != 0.0 || q->axes_d[1] != 0.0);
        struct path_move m = {
            .start_s = print_time, .accel_s = q->accel_t, .cruise_s = q->cruise_t, .decel_s = q->decel_t,
            .start_v = q->start_v, .cruise_v = q->cruise_v, .end_v = q->end_v, .distance_mm = q->move_d,
            .start_pos = { q->start_pos[0], q->start_pos[1], q->start_pos[2] },
            .end_pos = { q->end_pos[0], q->end_pos[1], q->end_pos[2] },
            .filament_mm = deposits ? q->axes_d[3] : 0.0, .fan = fan,
        };
        append(path, &m);
        print_time += duration_s(&m);
    }
    return starts || is_due(path, planned_s);
}

void tempplan_path_drop(struct tempplan_path *path, double until_s)
{
    while (path->count) {
        const struct path_move *m = &path->moves[path->first];
        if (m->start_s + duration_s(m) > until_s)
            return;
        path->first++;
        path->count--;
    }
}

/* -- pieces -- */

/* Material is deposited at z. Not 0: it is another layer than before. */
static int note_layer(struct tempplan_path *path, double z_mm)
{
    if (fabs(z_mm - path->z_mm) < SAME_Z_MM)
        return 0;
    double step_mm = z_mm - path->z_mm;
    int down = step_mm < 0.0, first = isnan(path->z_mm) || down;    /* down again: another object begins */
    path->layer = down ? 1.0 : path->layer + 1.0;
    path->height_mm = fmin(HEIGHT_MAX_MM, fmax(HEIGHT_MIN_MM, first ? z_mm : step_mm));
    path->z_mm = z_mm;
    return 1;
}

static struct tempplan_piece *new_pieces(struct tempplan_path *path, int more)
{
    if (path->piece_count + more > path->piece_room) {
        int room = path->piece_room ? path->piece_room : 256;
        while (room < path->piece_count + more)
            room *= 2;
        struct tempplan_piece *pieces = realloc(path->pieces, room * sizeof(*pieces));
        if (!pieces)
            return NULL;
        path->pieces = pieces;
        path->piece_room = room;
    }
    path->piece_count += more;
    return &path->pieces[path->piece_count - more];
}

/* Speeding up, cruise, braking, as far as there are. Returns how many. */
static int phases_of(const struct path_move *m, struct phase phases[PHASES])
{
    const double times_s[PHASES] = { m->accel_s, m->cruise_s, m->decel_s };
    const double speeds[PHASES] = { 0.5 * (m->start_v + m->cruise_v), m->cruise_v, 0.5 * (m->cruise_v + m->end_v) };
    int count = 0;
    struct phase whole = { 0.0, 0.0 };
    for (int i = 0; i < PHASES; i++) {
        if (times_s[i] <= TINY_S)
            continue;
        phases[count] = (struct phase){ times_s[i], speeds[i] * times_s[i] / m->distance_mm };
        whole.duration_s += phases[count].duration_s;
        whole.share += phases[count++].share;
    }
    if (whole.duration_s >= PHASE_MIN_S)
        return count;
    phases[0] = whole;
    return 1;
}

/* A place on the move (by path; the little that acceleration shifts it in time is left out). */
static void between(const struct path_move *m, double share, double place[3])
{
    for (int i = 0; i < 3; i++)
        place[i] = m->start_pos[i] + share * (m->end_pos[i] - m->start_pos[i]);
}

static int split(struct tempplan_path *path, const struct path_move *m, const struct path_request *request)
{
    struct phase phases[PHASES];
    int count = phases_of(m, phases);
    double time_s = 0.0, way = 0.0, volume_mm3 = m->filament_mm * path->filament_mm2;
    double height_mm = isnan(request->height_mm) ? path->height_mm : request->height_mm;
    for (int k = 0; k < count; k++) {
        int parts = (int)fmin(1e5, fmax(1.0, ceil(phases[k].share * m->distance_mm / path->longest_mm)));
        double part_s = phases[k].duration_s / parts, share = phases[k].share / parts;
        struct tempplan_piece *q = new_pieces(path, parts);
        if (!q)
            return -1;
        for (int i = 0; i < parts; i++, q++) {
            *q = (struct tempplan_piece){
                .start_s = m->start_s + time_s, .end_s = m->start_s + (time_s + part_s), .height_mm = height_mm,
                .flow_mm3_s = volume_mm3 * share / part_s, .fan = m->fan,
                .request_c = request->request_c, .base_c = request->base_c, .speed_factor = request->speed_factor,
            };
            between(m, way, q->start_pos);
            between(m, way + share, q->end_pos);
            time_s += part_s;
            way += share;
        }
        path->deposited += parts;
    }
    return 0;
}

static int travel(struct tempplan_path *path, const struct path_move *m, const struct path_request *request)
{
    struct tempplan_piece *q = new_pieces(path, 1);
    if (!q)
        return -1;
    *q = (struct tempplan_piece){
        .start_s = m->start_s, .end_s = m->start_s + duration_s(m), .height_mm = path->height_mm, .fan = m->fan,
        .request_c = NAN, .base_c = request->base_c, .speed_factor = 1.0,
    };
    memcpy(q->start_pos, m->start_pos, sizeof(q->start_pos));
    memcpy(q->end_pos, m->end_pos, sizeof(q->end_pos));
    return 0;
}

int tempplan_path_run(struct tempplan_path *path, const struct path_request *request, struct tempplan_piece **pieces)
{
    path->piece_count = 0;
    while (path->count) {
        const struct path_move *m = &path->moves[path->first];
        if (m->start_s >= request->until_s)
            break;
        int deposits = m->filament_mm > 0.0;
        if (deposits && note_layer(path, m->end_pos[2]) && request->by_place != 0.0)
            break;
        if (deposits ? split(path, m, request) : travel(path, m, request))
            return -1;
        path->first++;
        path->count--;
    }
    *pieces = path->pieces;
    return path->piece_count;
}

int tempplan_path_take(struct tempplan_path *path, const struct path_request *request, struct tempplan *tp)
{
    struct tempplan_piece *pieces;
    int count = tempplan_path_run(path, request, &pieces);
    if (count < 0 || (count && tempplan_add(tp, pieces, count)))
        return -1;
    return path->count;
}

int tempplan_path_turn(struct tempplan_path *path, const struct path_request *request, struct tempplan *tp, double from_s,
                       double within_c, double recorded_s, struct path_turn *turn, struct model_line *line, int room)
{
    int waiting = tempplan_path_take(path, request, tp);
    if (waiting)
        return waiting;
    turn->end_s = path->end_s;
    turn->count = tempplan_make(tp, from_s, tempplan_led(tp, from_s), within_c);
    if (turn->count <= room) {
        line->count = turn->count;
        model_line_fill(line, &tempplan_corners(tp)->time_s);
    }
    tempplan_finish(tp, recorded_s, NULL, 0);
    return 0;
}

void tempplan_path_facts(const struct tempplan_path *path, struct path_facts *facts)
{
    *facts = (struct path_facts){
        .next_s = path->count ? path->moves[path->first].start_s : NAN, .end_s = path->end_s,
        .layer = path->layer, .z_mm = path->z_mm, .height_mm = path->height_mm,
        .waiting = path->count, .deposited = path->deposited,
    };
}
