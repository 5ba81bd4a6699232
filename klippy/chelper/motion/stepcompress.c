/* Step times of one stepper -> queue_step commands: theory in stepcompress.h. */
#include "stepcompress.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum {
    RUN_MAX = 4096,                 /* steps looked at for one command: bounds the scratch arrays */
    ADD_MIN = -32768, ADD_MAX = 32767,
    SEARCH_TRIES = 8,
    STEPS_INITIAL = 1024, RECORDS_INITIAL = 64,
};

/* A pair step, step back within this time moves nothing but noise (a position resting on a step edge);
 * drivers and motors cannot follow it. */
#define CANCEL_WINDOW_S .000750
/* A command's interval must fit the MCU's 32-bit clock comparisons with room to spare. */
#define GAP_MAX_TICKS (UINT64_C(3) << 28)
/* After a long rest: where the new clock base lies before the first step, and how long after the last
 * step the MCU is surely idle. */
#define REBASE_LEAD_S .010
#define IDLE_AFTER_S .001
/* A command is due at the MCU when the one before ends, but no earlier than this before its first step. */
#define NEED_AHEAD_S .025

struct command { uint32_t interval; int32_t count, add; };

struct line_fit { double low, high; int count; };  /* feasible intercepts, gates passed */

struct stepcompress {
    uint32_t oid;
    int32_t tag_queue_step, tag_set_dir, tag_reset_clock;
    double max_error;               /* ticks */
    struct step_time_map map;
    int invert_dir;

    double *steps;                  /* wanted clocks not yet turned into commands: [head, tail) */
    size_t head, tail, capacity;
    int dir, can_cancel;            /* direction of those; is the newest one open to cancelling? */

    uint64_t last_clock;            /* clock of the last step in a command */
    double last_wanted;             /* the same before compression */
    int wire_dir, need_rebase;      /* direction pin as last sent (-1 unknown) */
    int64_t position;               /* after the last command */

    struct queue_message *out, **out_tail;
    struct step_record *records;    /* ring, running numbers like trapq */
    uint64_t record_first, record_next;
    size_t record_mask;

    double gate_low[RUN_MAX + 1], gate_high[RUN_MAX + 1];
    int gates, last_count;
};

static double reciprocal[RUN_MAX + 1];

static void *
need(void *memory)
{
    if (!memory)
        abort();
    return memory;
}

struct stepcompress *
stepcompress_alloc(uint32_t oid)
{
    if (reciprocal[1] != 1.)
        for (int k = 1; k <= RUN_MAX; k++)
            reciprocal[k] = 1. / k;
    struct stepcompress *sc = need(calloc(1, sizeof(*sc)));
    sc->oid = oid;
    sc->capacity = STEPS_INITIAL;
    sc->steps = need(malloc(sc->capacity * sizeof(*sc->steps)));
    sc->record_mask = RECORDS_INITIAL - 1;
    sc->records = need(malloc(RECORDS_INITIAL * sizeof(*sc->records)));
    sc->out_tail = &sc->out;
    sc->wire_dir = -1;
    sc->need_rebase = 1;
    sc->map.freq = 1.;
    return sc;
}

void
stepcompress_free(struct stepcompress *sc)
{
    if (!sc)
        return;
    message_free_list(sc->out);
    free(sc->steps);
    free(sc->records);
    free(sc);
}

void
stepcompress_setup(struct stepcompress *sc, uint32_t max_error, int32_t queue_step_tag,
                   int32_t set_next_step_dir_tag, int32_t reset_step_clock_tag)
{
    sc->max_error = max_error;
    sc->tag_queue_step = queue_step_tag;
    sc->tag_set_dir = set_next_step_dir_tag;
    sc->tag_reset_clock = reset_step_clock_tag;
}

void
stepcompress_set_invert_dir(struct stepcompress *sc, int invert)
{
    if (sc->invert_dir != !!invert)
        sc->wire_dir = -1;
    sc->invert_dir = !!invert;
}

void
stepcompress_set_time(struct stepcompress *sc, double time_offset, double freq)
{
    sc->map = (struct step_time_map){ time_offset, freq };
}

struct step_time_map
stepcompress_time_map(const struct stepcompress *sc)
{
    return sc->map;
}

uint64_t
stepcompress_last_clock(const struct stepcompress *sc)
{
    return sc->last_clock;
}

double
stepcompress_last_known(const struct stepcompress *sc)
{
    return sc->tail > sc->head ? sc->steps[sc->tail - 1] : (double)sc->last_clock;
}

struct queue_message **
stepcompress_output(struct stepcompress *sc)
{
    return &sc->out;
}

/* ---- history ---- */

static struct step_record *
record_at(const struct stepcompress *sc, uint64_t number)
{
    return &sc->records[number & sc->record_mask];
}

static void
record_push(struct stepcompress *sc, struct step_record r)
{
    if (sc->record_next - sc->record_first > sc->record_mask) {
        size_t capacity = (sc->record_mask + 1) * 2;
        struct step_record *ring = need(malloc(capacity * sizeof(*ring)));
        for (uint64_t n = sc->record_first; n < sc->record_next; n++)
            ring[n & (capacity - 1)] = *record_at(sc, n);
        free(sc->records);
        sc->records = ring;
        sc->record_mask = capacity - 1;
    }
    *record_at(sc, sc->record_next++) = r;
}

void
stepcompress_forget_before(struct stepcompress *sc, uint64_t clock)
{
    while (sc->record_first < sc->record_next && record_at(sc, sc->record_first)->last_clock < clock)
        sc->record_first++;
}

/* Number of the first record whose last step is later than clock. */
static uint64_t
record_after(const struct stepcompress *sc, uint64_t clock)
{
    uint64_t low = sc->record_first, high = sc->record_next;
    while (low < high) {
        uint64_t middle = low + (high - low) / 2;
        if (record_at(sc, middle)->last_clock <= clock)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

/* Steps of one record made up to and including clock. */
static int64_t
steps_done(const struct step_record *r, uint64_t clock)
{
    int64_t total = llabs((int64_t)r->step_count);
    if (clock < r->first_clock)
        return 0;
    int64_t low = 1, high = total;  /* step `low` is known to be made */
    while (low < high) {
        int64_t k = low + (high - low + 1) / 2;
        int64_t since_first = (k - 1) * (int64_t)r->interval + (int64_t)r->add * (k * (k - 1) / 2);
        if (since_first <= (int64_t)(clock - r->first_clock))
            low = k;
        else
            high = k - 1;
    }
    return low;
}

/* Position in steps (as commanded, before dir inversion) at a clock; the oldest known if it is forgotten. */
int64_t
stepcompress_position_at(const struct stepcompress *sc, uint64_t clock)
{
    uint64_t number = record_after(sc, clock);
    if (number == sc->record_next)
        return sc->position;
    const struct step_record *r = record_at(sc, number);
    int64_t done = steps_done(r, clock);
    return r->start_position + (r->step_count < 0 ? -done : done);
}

int
stepcompress_history(const struct stepcompress *sc, struct step_record *out, int max,
                     uint64_t start_clock, uint64_t end_clock)
{
    int count = 0;
    uint64_t number = start_clock ? record_after(sc, start_clock - 1) : sc->record_first;
    for (; number < sc->record_next && count < max; number++) {
        const struct step_record *r = record_at(sc, number);
        if (r->first_clock >= end_clock)
            break;
        out[count++] = *r;
    }
    return count;
}

/* ---- messages ---- */

/* Command id and object id. Tags are signed; everything else is encoded at the width the firmware declares. */
static uint8_t *
put_head(const struct stepcompress *sc, uint8_t *p, int32_t tag)
{
    return vlq_encode(vlq_encode(p, tag), sc->oid);
}

static void
emit(struct stepcompress *sc, struct queue_message *m, const uint8_t *end, uint64_t req_clock,
     uint64_t free_clock, int takes_place)
{
    m->len = (int)(end - m->data);
    m->req_clock = req_clock;
    m->min_clock = free_clock;
    m->notify_id = (uint64_t)takes_place;
    m->next = NULL;
    if (!sc->out)
        sc->out_tail = &sc->out;
    *sc->out_tail = m;
    sc->out_tail = &m->next;
}

/* A step wanted at the very time of the one before (a reversal next to a flush) follows it at this distance. */
#define CROWDED_TICKS 40
/* After a long rest (or a reset) give the MCU a new clock base shortly before the next step. */
static void
emit_rebase(struct stepcompress *sc, uint64_t first_clock)
{
    uint64_t idle_clock = sc->last_clock ? sc->last_clock + (uint64_t)(IDLE_AFTER_S * sc->map.freq) : 0;
    uint64_t lead = (uint64_t)(REBASE_LEAD_S * sc->map.freq);
    uint64_t base = first_clock > lead ? first_clock - lead : 0;
    if (base < sc->last_clock)
        base = sc->last_clock;
    uint64_t ahead = (uint64_t)(NEED_AHEAD_S * sc->map.freq);
    uint64_t need_clock = base > ahead ? base - ahead : 0;
    if (need_clock < sc->last_clock)
        need_clock = sc->last_clock;
    struct queue_message *m = message_alloc();
    uint8_t *p = vlq_encode(put_head(sc, m->data, sc->tag_reset_clock), (uint32_t)base);
    emit(sc, m, p, need_clock, idle_clock, 0);
    sc->last_clock = base;
    sc->need_rebase = 0;
}

static void
emit_command(struct stepcompress *sc, struct command c)
{
    uint64_t base = sc->last_clock;
    uint64_t k = (uint64_t)c.count;
    uint64_t first = base + c.interval;
    uint64_t last = base + k * c.interval + (uint64_t)((int64_t)c.add * (int64_t)(k * (k - 1) / 2));
    uint64_t ahead = (uint64_t)(NEED_AHEAD_S * sc->map.freq);

    struct queue_message *m = message_alloc();
    uint8_t *p = m->data;
    int wire_dir = sc->dir ^ sc->invert_dir;
    if (wire_dir != sc->wire_dir) {
        p = vlq_encode(put_head(sc, p, sc->tag_set_dir), wire_dir);
        sc->wire_dir = wire_dir;
    }
    p = put_head(sc, p, sc->tag_queue_step);
    p = vlq_encode(vlq_encode(vlq_encode(p, c.interval), c.count), c.add);
    emit(sc, m, p, c.interval > ahead ? first - ahead : base, last, 1);

    int32_t signed_count = sc->dir ? c.count : -c.count;
    record_push(sc, (struct step_record){ first, last, sc->position, signed_count, c.interval, c.add });
    sc->position += signed_count;
    sc->last_clock = last;
}

/* ---- the fit ---- */

/* Gate k (1-based) in the divided form; computed as far as a search needs it. */
static void
make_gates(struct stepcompress *sc, int upto)
{
    const double *wanted = &sc->steps[sc->head];
    double base = (double)sc->last_clock;
    for (int k = sc->gates + 1; k <= upto; k++) {
        double before = k > 1 ? wanted[k - 2] : sc->last_wanted;
        double tolerance = .5 * (wanted[k - 1] - before);
        if (tolerance > sc->max_error)
            tolerance = sc->max_error;
        double high = wanted[k - 1] - base;
        sc->gate_low[k] = (high - tolerance) * reciprocal[k];
        sc->gate_high[k] = high * reciprocal[k];
    }
    if (upto > sc->gates)
        sc->gates = upto;
}

/* Run a line of slope `add` through the gates until one stops it or `limit` is reached. */
static struct line_fit
run_line(struct stepcompress *sc, int add, int limit)
{
    struct line_fit fit = { 1., UINT32_MAX, 0 };    /* no step at the clock of the one before */
    double half_add = .5 * add;
    for (int k = 1; k <= limit; k++) {
        if (k > sc->gates)
            make_gates(sc, k + 15 < limit ? k + 15 : limit);
        double shift = half_add * (k - 1);
        double low = sc->gate_low[k] - shift, high = sc->gate_high[k] - shift;
        if (low < fit.low)
            low = fit.low;
        if (high > fit.high)
            high = fit.high;
        /* a whole number must fit between: certain if the room is 1 or more */
        if (high - low < 1. && !(floor(high) >= low))
            break;
        fit = (struct line_fit){ low, high, k };
    }
    return fit;
}

/* Slopes that can connect gate k with every earlier one. */
static void
narrow_slopes(const struct stepcompress *sc, int k, double *slope_min, double *slope_max)
{
    double low = sc->gate_low[k], high = sc->gate_high[k];
    double steepest = *slope_max, flattest = *slope_min;
    for (int j = 1; j < k; j++) {
        double per_step = 2. * reciprocal[k - j];       /* 1 / (x_k - x_j) */
        double up = (high - sc->gate_low[j]) * per_step;
        double down = (low - sc->gate_high[j]) * per_step;
        steepest = up < steepest ? up : steepest;
        flattest = down > flattest ? down : flattest;
    }
    *slope_min = flattest;
    *slope_max = steepest;
}

/* A first slope from the middles of two gates. */
static int
guess_slope(struct stepcompress *sc, int limit)
{
    int far = sc->last_count + sc->last_count / 4 + 2;
    if (far > limit)
        far = limit;
    int near = far > 3 ? far / 2 : 1;
    if (near >= far)
        return 0;
    make_gates(sc, far);
    double rise = sc->gate_low[far] + sc->gate_high[far] - sc->gate_low[near] - sc->gate_high[near];
    double slope = rise * reciprocal[far - near];
    return (int)lrint(slope < ADD_MIN ? ADD_MIN : slope > ADD_MAX ? ADD_MAX : slope);
}

static struct command
fit_command(struct stepcompress *sc)
{
    size_t waiting = sc->tail - sc->head;
    int limit = waiting > RUN_MAX ? RUN_MAX : (int)waiting;
    sc->gates = 0;
    int add = guess_slope(sc, limit), best_add = add;
    struct line_fit best = { 0., 0., 0 };
    double slope_min = ADD_MIN, slope_max = ADD_MAX;
    for (int attempt = 0; attempt < SEARCH_TRIES; attempt++) {
        struct line_fit fit = run_line(sc, add, limit);
        if (fit.count > best.count) {
            best = fit;
            best_add = add;
        }
        if (fit.count >= limit || !fit.count)
            break;
        narrow_slopes(sc, fit.count + 1, &slope_min, &slope_max);
        double first = ceil(slope_min), last = floor(slope_max);
        if (first > last)
            break;
        int next = (int)lrint(.5 * (first + last));
        if (next == add)            /* stopped for want of a whole interval, not of slope */
            break;
        add = next;
    }
    /* the latest that fits: nearest to what is wanted, and the last step before a rest is just that */
    double interval = floor(best.high);
    if (best.count == 1)
        best_add = 0;
    sc->last_count = best.count;
    return (struct command){ (uint32_t)interval, best.count, best_add };
}

int
stepcompress_flush(struct stepcompress *sc, uint64_t clock)
{
    while (sc->head < sc->tail && sc->steps[sc->head] <= (double)clock) {
        double first = sc->steps[sc->head];
        if (sc->need_rebase || first > (double)(sc->last_clock + GAP_MAX_TICKS)) {
            emit_rebase(sc, (uint64_t)first);
            sc->last_wanted = (double)sc->last_clock;
        }
        struct command c = fit_command(sc);
        if (!c.count) {
            double late = (double)sc->last_clock - first;
            if (late > sc->max_error)
                return STEPCOMPRESS_PAST;
            c = (struct command){ CROWDED_TICKS, 1, 0 };
        }
        emit_command(sc, c);
        sc->head += (size_t)c.count;
        sc->last_wanted = sc->steps[sc->head - 1];
    }
    if (sc->head == sc->tail)
        sc->can_cancel = 0;
    return STEPCOMPRESS_OK;
}

/* ---- input ---- */

double *
stepcompress_reserve(struct stepcompress *sc, int dir, size_t count, double first_clock, size_t *skip)
{
    *skip = 0;
    if (dir != sc->dir) {
        if (sc->tail > sc->head && sc->can_cancel
            && first_clock - sc->steps[sc->tail - 1] < CANCEL_WINDOW_S * sc->map.freq) {
            sc->tail--;
            sc->can_cancel = 0;
            *skip = 1;
            count--;
        }
        if (count && sc->tail > sc->head && stepcompress_flush(sc, UINT64_MAX))
            return NULL;
        if (count)
            sc->dir = dir;
    }
    if (sc->tail + count > sc->capacity) {
        size_t waiting = sc->tail - sc->head;
        memmove(sc->steps, &sc->steps[sc->head], waiting * sizeof(*sc->steps));
        sc->head = 0;
        sc->tail = waiting;
        if (waiting + count > sc->capacity) {
            while (waiting + count > sc->capacity)
                sc->capacity *= 2;
            sc->steps = need(realloc(sc->steps, sc->capacity * sizeof(*sc->steps)));
        }
    }
    return &sc->steps[sc->tail];
}

void
stepcompress_commit(struct stepcompress *sc, size_t count)
{
    sc->tail += count;
    if (count)
        sc->can_cancel = 1;
}

int
stepcompress_reset(struct stepcompress *sc, uint64_t clock, int64_t position)
{
    message_free_list(sc->out);
    sc->out = NULL;
    sc->out_tail = &sc->out;
    sc->head = sc->tail = 0;
    sc->can_cancel = 0;
    int32_t moved = (int32_t)(position - sc->position);
    if (moved) {                    /* the records of steps that were never made stay, as if taken back after them */
        uint64_t at = clock > sc->last_clock ? clock : sc->last_clock;
        record_push(sc, (struct step_record){ at, at, sc->position, moved, 0, 0 });
    }
    sc->position = position;
    sc->last_clock = clock;
    sc->need_rebase = 1;
    sc->wire_dir = -1;
    return STEPCOMPRESS_OK;
}
