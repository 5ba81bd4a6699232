/* The induction heater: bridge, synchronous ADC and guard behind messages.
 *
 *   queue_induction_plan ─► pending phases ─► timer at their clock ─► bridge_pwm             (phase.h)
 *                                                  │ sample index of each step
 *   induction_block  ◄─ task ◄─ ring of blocks ◄─ ADC interrupt ◄─ half buffers        (oversample.h)
 *                                                  └► guard ─► bridge off, shutdown    (guard.h)
 *
 * Who calls what:
 *   task    command handlers; induction_task (sends reports)
 *   timer   phase_timer: applies pending phases, watches max_duration.  Two of its clocks can coincide; late by up to
 *           a bridge period is unseen (the bridge changes at period edges), later only delays the heat.
 *   irq     samples_ready: every HALF_LEN bridge periods (32: 267 us at 120 kHz).  Must end before the next one is due.
 *           On a Cortex-M4 at 72 MHz: about 14 cycles a sample in portable C (4 with a port's own kernel,
 *           oversample_kernel.h) and some 300 around them, 4 % of the time.  Counted from the compiler's output.
 *           Late by more than a half buffer: the samples count as lost, blocks are cut there, indices stay right.
 * Timers and interrupts do not preempt each other (sched.h); tasks disable interrupts around what both touch.
 *
 * Safety.  The bridge is off at boot, on every shutdown, on a trip of the guard, and max_duration after the last applied
 * phase command: all in interrupts, host alive or not.  A tripped guard refuses phases until the next configuration.
 * A host that was only late goes on with its next command: what it had queued before is forgotten.
 *
 * Sample n is taken at start_clock + n * period_ticks.  A phase set now holds from sample sync_adc_position() on.
 */
#include <string.h>

#include "basecmd.h"
#include "board/bridge_pwm.h"
#include "board/irq.h"
#include "board/sync_adc.h"
#include "board/timer.h"
#include "command.h"
#include "guard.h"
#include "induction_timing.h"
#include "oversample.h"
#include "phase.h"
#include "sched.h"

#ifdef PORT_SYNC_HALF_LEN
enum { HALF_LEN = PORT_SYNC_HALF_LEN };
#else
enum { HALF_LEN = 32 };
#endif

enum {
    SYNC_ADC_MAX = 4095,     /* the synchronous ADC has 12 bits on every port */
    BLOCKS_WAITING_MAX = 32, /* power of two; 51 ms of blocks of 192 samples for a host link that stalls */
    RECORD_SIZE_MAX = 16,
    DATA_SIZE_MAX = 48,      /* what fits one message: 7 plain records, 3 of the longest */
    RECORDS_MAX = 7,
    LONE_RECORD_US = 20000,  /* a record that would wait longer for others goes without them */
    LATE_MARGIN_US = 20,     /* a late phase command is applied so much after its arrival */
    SILENCE_US = 3000000,    /* a host that is silent for longer is dead; queued motion lasts no longer */
};

DECL_CONSTANT("INDUCTION_FREQUENCY", INDUCTION_FREQUENCY);
DECL_CONSTANT("INDUCTION_OVERSAMPLE", INDUCTION_OVERSAMPLE);
DECL_CONSTANT("INDUCTION_BLOCK_SAMPLES", INDUCTION_BLOCK_SAMPLES);
DECL_CONSTANT("INDUCTION_SETTLE_SAMPLES", INDUCTION_SETTLE_SAMPLES);
DECL_CONSTANT("INDUCTION_RECORDS", INDUCTION_RECORDS);
DECL_CONSTANT("INDUCTION_LEAD_US", INDUCTION_LEAD_US);
DECL_CONSTANT("INDUCTION_LIMIT_ROWS", GUARD_ROWS_MAX);
DECL_CONSTANT("INDUCTION_Y_MIN", OVERSAMPLE_Y_MIN);
DECL_CONSTANT("INDUCTION_Y_MAX", OVERSAMPLE_Y_MAX);
DECL_ENUMERATION("induction_trip", "none", GUARD_TRIP_NONE);
DECL_ENUMERATION("induction_trip", "low", GUARD_TRIP_LOW);
DECL_ENUMERATION("induction_trip", "high", GUARD_TRIP_HIGH);
DECL_ENUMERATION("induction_trip", "clipped", GUARD_TRIP_CLIPPED);
DECL_ENUMERATION("induction_trip", "stuck", GUARD_TRIP_STUCK);
DECL_ENUMERATION("induction_trip", "timeout", GUARD_TRIP_TIMEOUT);

DECL_RESPONSE(response_induction_state, "induction_state oid=%c clock=%u phase=%hu trip=%c value=%u");
DECL_RESPONSE(response_induction_block, "induction_block oid=%c sequence=%hu clock=%u data=%*s");

struct induction {
    struct timer timer;
    struct bridge_pwm bridge;
    struct sync_adc adc;
    uint32_t period_ticks, start_clock;
    uint32_t next_index;    /* first sample not yet accounted for */
    uint32_t hold_samples;  /* how long a lone record waits */
    uint8_t oid, sampling, reporting, resync;
    uint8_t records;        /* sent together */
    struct phase_schedule schedule;
    struct oversample oversample;
    struct guard guard;
    /* finished blocks, irq to task: numbers run, places are modulo the length */
    struct oversample_block waiting[BLOCKS_WAITING_MAX];
    struct oversample_block surplus;  /* one that finds no place */
    uint32_t newest_sum;
    uint16_t newest_count;
    uint16_t sequence;      /* of the oldest waiting block */
    uint8_t block_head, block_tail;
};

static struct induction *unit;  /* the one induction heater of this MCU; samples_ready gets no object */
static struct task_wake report_wake;

void
induction_init(void)
{
    unit = NULL;
    report_wake.wake = 0;
}
DECL_INIT(induction_init);

/****************************************************************
 * Phases (timer context)
 ****************************************************************/

static void
apply_phase(struct induction *u, uint16_t phase, uint32_t clock)
{
    bridge_pwm_set_phase(u->bridge, phase);
    phase_applied(&u->schedule, sync_adc_position(u->adc), phase);
    guard_fed(&u->guard, clock, phase);
}

/* Any context, interrupts disabled. */
static void
bridge_off(struct induction *u)
{
    bridge_pwm_off(u->bridge);
    phase_applied(&u->schedule, sync_adc_position(u->adc), 0);
}

static void
switch_off(struct induction *u)
{
    bridge_off(u);
    guard_off(&u->guard);
}

static _Noreturn void
trip(struct induction *u, enum guard_trip reason)
{
    static const enum shutdown_reason reasons[] = {
        [GUARD_TRIP_LOW] = SHUTDOWN_INDUCTION_LOW,         [GUARD_TRIP_HIGH] = SHUTDOWN_INDUCTION_HIGH,
        [GUARD_TRIP_CLIPPED] = SHUTDOWN_INDUCTION_CLIPPED, [GUARD_TRIP_STUCK] = SHUTDOWN_INDUCTION_STUCK,
        [GUARD_TRIP_TIMEOUT] = SHUTDOWN_INDUCTION_TIMEOUT,
    };
    switch_off(u);
    shutdown(reasons[reason]);
}

/* When phase_timer must run next; 0 if it need not. */
static uint8_t
next_event(const struct induction *u, uint32_t *clock)
{
    const struct phase_node *pending = u->schedule.first;
    if (!pending && !guard_is_waiting(&u->guard))
        return 0;
    *clock = pending ? pending->due : guard_deadline(&u->guard);
    if (pending && guard_is_waiting(&u->guard) && timer_is_before(guard_deadline(&u->guard), *clock))
        *clock = guard_deadline(&u->guard);
    return 1;
}

static void
free_nodes(struct phase_node *node)
{
    while (node) {
        struct phase_node *next = node->next;
        move_free(node);
        node = next;
    }
}

static uint8_t
phase_timer(struct timer *t)
{
    struct induction *u = container_of(t, struct induction, timer);
    uint32_t now = timer_read_time();
    for (struct phase_node *node; (node = phase_pop_due(&u->schedule, now));) {
        apply_phase(u, node->phase, now);
        move_free(node);
    }
    if (guard_lapse(&u->guard, now)) {
        bridge_off(u);
        free_nodes(u->schedule.first);
        phase_forget(&u->schedule);
    }
    enum guard_trip tripped = guard_check_silence(&u->guard, now);
    if (tripped != GUARD_TRIP_NONE)
        trip(u, tripped);
    return next_event(u, &t->waketime) ? SF_RESCHEDULE : SF_DONE;
}

/****************************************************************
 * Samples (irq context)
 ****************************************************************/

static uint8_t
blocks_waiting(const struct induction *u)
{
    return (uint8_t)(u->block_head - u->block_tail);
}

/* Where the next finished block goes: its place in the ring, so that it need not be copied. */
static struct oversample_block *
next_block(struct induction *u)
{
    if (blocks_waiting(u) == BLOCKS_WAITING_MAX)
        return &u->surplus;
    return &u->waiting[u->block_head & (BLOCKS_WAITING_MAX - 1)];
}

/* A finished block in next_block(): judged, then kept for the host. */
static void
take_block(struct induction *u, const struct oversample_block *b)
{
    u->newest_sum = b->sum;
    u->newest_count = b->count;
    struct guard_input seen = {.sum = b->sum, .count = b->count, .phase = b->phase, .min = b->min, .max = b->max};
    enum guard_trip tripped = guard_block(&u->guard, &seen);
    if (tripped != GUARD_TRIP_NONE)
        trip(u, tripped);
    if (!u->reporting)
        return;
    if (b == &u->surplus)
        oversample_drop(&u->oversample, b);
    else
        u->block_head++;
}

static void
take_samples(struct induction *u, const uint16_t *samples, uint16_t count)
{
    struct oversample_block *b = next_block(u);
    while (count) {
        uint16_t run, taken;
        uint16_t phase = phase_run(&u->schedule, u->next_index, count, &run);
        if (oversample_step(&u->oversample, phase, b)) {
            take_block(u, b);
            b = next_block(u);
        }
        for (; run; run -= taken, count -= taken, samples += taken) {
            uint8_t finished = oversample_feed(&u->oversample, samples, run, u->next_index, &taken, b);
            u->next_index += taken;
            if (!finished)
                continue;
            take_block(u, b);
            b = next_block(u);
        }
    }
}

/* Are there enough records to send, and if not, have they waited long enough? */
static uint8_t
records_to_send(const struct induction *u)
{
    uint8_t waiting = blocks_waiting(u);
    if (waiting >= u->records)
        return u->records;
    if (!waiting || u->oversample.block_len > u->hold_samples)
        return waiting;
    const struct oversample_block *b = &u->waiting[u->block_tail & (BLOCKS_WAITING_MAX - 1)];
    return u->next_index - (b->first + b->count) >= u->hold_samples;
}

/* Index after the newest complete half buffer. */
static uint32_t
newest_end(uint32_t position)
{
    return position - position % HALF_LEN;
}

static void
samples_ready(const uint16_t *samples, uint16_t count)
{
    struct induction *u = unit;
    if (!u)
        return;
    uint32_t position = sync_adc_position(u->adc);
    if (u->resync) {
        u->resync = 0;
        u->next_index = newest_end(position) - count;
        oversample_init(&u->oversample, u->oversample.config);
    }
    uint32_t ahead = position - u->next_index;
    if (ahead < count)
        return;  /* part of a gap already reported */
    if (ahead > 2u * HALF_LEN) {
        struct oversample_block *b = next_block(u);
        uint32_t lost = newest_end(position) - u->next_index;
        u->next_index += lost;
        if (oversample_gap(&u->oversample, lost, b))
            take_block(u, b);
    } else {
        take_samples(u, samples, count);
    }
    if (u->reporting && records_to_send(u))
        sched_wake_task(&report_wake);
}

/****************************************************************
 * Reports (task context)
 ****************************************************************/

/* A record, little endian, the optional parts in this order:
 *
 *     u16 bits 0-11 lowest sample, bits 12-15 flags · u8 highest - lowest · u24 value
 *     PHASE u16 phase (else as in the record before; always in a message's first)
 *     CUT   u16 count (else block_len)
 *     GAP   u16 discarded · u16 lost (else 0)
 *     WIDE  u16 highest sample (the u8 is then 255)
 *
 * 6 bytes for a whole block under an unchanged phase, 16 at most.  The message's clock is that of its first record's first
 * sample; the next record's lies count periods on, and discarded + lost more, because every sample is accounted for.  Only
 * where those two saturate that would not hold: such a record begins a message.
 */
enum { RECORD_PHASE = 0x1000, RECORD_CUT = 0x2000, RECORD_GAP = 0x4000, RECORD_WIDE = 0x8000, WIDE_SPAN = 255 };

static uint8_t *
put_u16(uint8_t *p, uint16_t v)
{
    *p++ = (uint8_t)v;
    *p++ = (uint8_t)(v >> 8);
    return p;
}

/* `before` is the record before in the same message, or NULL. */
static uint8_t *
put_record(uint8_t *p, const struct oversample_block *b, const struct oversample_block *before, uint16_t block_len)
{
    uint16_t span = b->max - b->min, flags = 0;
    flags |= !before || before->phase != b->phase ? RECORD_PHASE : 0;
    flags |= b->count != block_len ? RECORD_CUT : 0;
    flags |= b->discarded || b->lost ? RECORD_GAP : 0;
    flags |= span >= WIDE_SPAN ? RECORD_WIDE : 0;
    p = put_u16(p, (b->min & SYNC_ADC_MAX) | flags);
    *p++ = flags & RECORD_WIDE ? WIDE_SPAN : (uint8_t)span;
    p = put_u16(p, (uint16_t)b->value);
    *p++ = (uint8_t)(b->value >> 16);
    if (flags & RECORD_PHASE)
        p = put_u16(p, b->phase);
    if (flags & RECORD_CUT)
        p = put_u16(p, b->count);
    if (flags & RECORD_GAP)
        p = put_u16(put_u16(p, b->discarded), b->lost);
    return flags & RECORD_WIDE ? put_u16(p, b->max) : p;
}

static uint8_t
saturated(const struct oversample_block *b)
{
    return b->discarded == UINT16_MAX || b->lost == UINT16_MAX;
}

/* One message of as many records as are due and fit. Returns 1 if there may be more. */
static uint8_t
send_report(struct induction *u)
{
    uint8_t data[DATA_SIZE_MAX + RECORD_SIZE_MAX], *end = data;
    const struct oversample_block *before = NULL;
    irqstatus_t flag = irq_save();
    uint8_t ready = u->reporting ? records_to_send(u) : 0, records = 0;
    uint16_t sequence = u->sequence;
    uint32_t from = u->waiting[u->block_tail & (BLOCKS_WAITING_MAX - 1)].first;
    for (; records < ready; records++) {
        const struct oversample_block *b = &u->waiting[u->block_tail & (BLOCKS_WAITING_MAX - 1)];
        if (before && saturated(b))
            break;
        uint8_t *after = put_record(end, b, before, u->oversample.block_len);
        if (after > data + DATA_SIZE_MAX)
            break;
        end = after;
        before = b;
        u->block_tail++;
    }
    u->sequence += records;
    uint8_t more = records && blocks_waiting(u);
    irq_restore(flag);
    if (records)
        respond(&response_induction_block, u->oid, sequence, u->start_clock + from * u->period_ticks,
                (unsigned)(end - data), data);
    return more;
}

void
induction_task(void)
{
    struct induction *u = unit;
    if (!sched_check_wake(&report_wake) || !u)
        return;
    while (send_report(u))
        ;
}
DECL_TASK(induction_task);

/****************************************************************
 * Commands (task context)
 ****************************************************************/

void
command_config_induction(const struct command_args *args)
{
    struct induction *u = oid_alloc((uint8_t)args->val[0], command_config_induction, sizeof(*u));
    uint32_t period_ticks = args->val[3], phase_max = args->val[4], max_duration = args->val[5];
    /* Half the clock's range: a deadline must be tellable from the past. */
    if (unit || phase_max > BRIDGE_PHASE_MAX || !max_duration || max_duration > INT32_MAX / 2)
        shutdown(SHUTDOWN_INDUCTION_CONFIG);
    u->oid = (uint8_t)args->val[0];
    u->bridge = bridge_pwm_setup((uint8_t)args->val[1], period_ticks);
    u->adc = sync_adc_setup(args->val[2], u->bridge, HALF_LEN, samples_ready);
    u->period_ticks = period_ticks;
    u->hold_samples = timer_from_us(LONE_RECORD_US) / period_ticks;
    u->records = INDUCTION_RECORDS;
    u->timer.func = phase_timer;
    phase_init(&u->schedule, (uint16_t)phase_max);
    guard_init(&u->guard, SYNC_ADC_MAX, max_duration, timer_from_us(SILENCE_US));
    oversample_init(&u->oversample, (struct oversample_config){.y = INDUCTION_OVERSAMPLE,
                                                                .settle_samples = INDUCTION_SETTLE_SAMPLES,
                                                                .block_len = INDUCTION_BLOCK_SAMPLES});
    move_request_size(sizeof(struct phase_node));
    unit = u;
}
DECL_COMMAND(command_config_induction,
             "config_induction oid=%c bridge=%c adc_pin=%u period_ticks=%u phase_max=%hu max_duration=%u");

void
command_config_induction_sense(const struct command_args *args)
{
    struct induction *u = oid_lookup((uint8_t)args->val[0], command_config_induction);
    struct oversample_config config = {
        .y = (uint8_t)args->val[1],
        .settle_samples = (uint16_t)args->val[2],
        .ema_shift = (uint8_t)args->val[3],
    };
    if (u->sampling || !oversample_init(&u->oversample, config))
        shutdown(SHUTDOWN_INDUCTION_CONFIG);
}
DECL_COMMAND(command_config_induction_sense,
             "config_induction_sense oid=%c oversample=%c settle_samples=%hu ema_shift=%c");

/* Shorter blocks than 4^oversample samples, and how many records go together; after config_induction_sense. */
void
command_config_induction_block(const struct command_args *args)
{
    struct induction *u = oid_lookup((uint8_t)args->val[0], command_config_induction);
    struct oversample_config config = u->oversample.config;
    config.block_len = (uint16_t)args->val[1];
    uint8_t records = (uint8_t)args->val[2];
    if (u->sampling || !records || records > RECORDS_MAX || !oversample_init(&u->oversample, config))
        shutdown(SHUTDOWN_INDUCTION_CONFIG);
    u->records = records;
}
DECL_COMMAND(command_config_induction_block, "config_induction_block oid=%c samples=%hu records=%c");

void
command_config_induction_limit(const struct command_args *args)
{
    struct induction *u = oid_lookup((uint8_t)args->val[0], command_config_induction);
    struct guard_row row = {
        .phase = (uint16_t)args->val[1],
        .low = (uint16_t)args->val[2],
        .high = (uint16_t)args->val[3],
        .trip_blocks = (uint8_t)args->val[4],
    };
    if (u->sampling || !guard_add_row(&u->guard, row))
        shutdown(SHUTDOWN_INDUCTION_CONFIG);
}
DECL_COMMAND(command_config_induction_limit,
             "config_induction_limit oid=%c phase=%hu low=%hu high=%hu trip_blocks=%c");

/* Sampling starts before the first heat and never stops: the guard judges also when nobody wants reports. */
static void
start_sampling(struct induction *u)
{
    if (u->sampling)
        return;
    u->sampling = 1;
    irqstatus_t flag = irq_save();
    u->start_clock = sync_adc_start(u->adc);
    u->next_index = 0;
    irq_restore(flag);
}

/* Did the line hold back a step for so long that its time is over?  Then it gives no power. */
static uint8_t
is_stale(const struct induction *u, uint32_t at)
{
    int32_t late = (int32_t)(timer_read_time() - at);
    return late > (int32_t)u->guard.max_duration;
}

/* One step of the bridge at a clock, after all that are queued. */
static void
queue_step(struct induction *u, uint32_t at, uint32_t phase)
{
    if (phase > BRIDGE_PHASE_MAX)
        shutdown(SHUTDOWN_INDUCTION_PHASE);
    if (u->guard.trip)
        trip(u, (enum guard_trip)u->guard.trip);
    start_sampling(u);
    struct phase_node *node = move_alloc();
    node->clock = at;
    node->phase = is_stale(u, at) ? 0 : (uint16_t)phase;
    irqstatus_t flag = irq_save();
    uint32_t clock, earliest = timer_read_time() + timer_from_us(LATE_MARGIN_US);
    if (!phase_push(&u->schedule, node, earliest)) {
        move_free(node);
        shutdown(SHUTDOWN_INDUCTION_ORDER);
    }
    if (u->schedule.first == node && next_event(u, &clock)) {
        sched_del_timer(&u->timer);
        u->timer.waketime = timer_is_before(clock, earliest) ? earliest : clock;
        sched_add_timer(&u->timer);
    }
    irq_restore(flag);
}

/* What the host means to do from `clock` on, in place of all that was pending from there on: a host that comes late has
 * said before what to do meanwhile.  steps: u16 bridge periods after the step before (the first: after `clock`) · u16
 * phase, little endian.  The watchdog counts from the last step applied. */
enum { PLAN_STEP_SIZE = 4 };

void
command_queue_induction_plan(const struct command_args *args)
{
    struct induction *u = oid_lookup((uint8_t)args->val[0], command_config_induction);
    const uint8_t *p = args->data, *end = p + args->data_len;
    uint32_t clock = args->val[1];
    if (args->data_len % PLAN_STEP_SIZE)
        shutdown(SHUTDOWN_INDUCTION_PHASE);
    irqstatus_t flag = irq_save();
    struct phase_node *stale = phase_cut(&u->schedule, clock);
    irq_restore(flag);
    free_nodes(stale);
    for (; p < end; p += PLAN_STEP_SIZE) {
        clock += (uint32_t)(p[0] | p[1] << 8) * u->period_ticks;
        queue_step(u, clock, (uint32_t)p[2] | (uint32_t)p[3] << 8);
    }
}
DECL_COMMAND(command_queue_induction_plan, "queue_induction_plan oid=%c clock=%u steps=%*s");

void
command_induction_report(const struct command_args *args)
{
    struct induction *u = oid_lookup((uint8_t)args->val[0], command_config_induction);
    start_sampling(u);
    irqstatus_t flag = irq_save();
    uint8_t enable = args->val[1] != 0;
    if (enable != u->reporting) {
        u->block_tail = u->block_head;
        u->sequence = 0;
        u->resync = 1;
    }
    u->reporting = enable;
    irq_restore(flag);
}
DECL_COMMAND(command_induction_report, "induction_report oid=%c enable=%c");

/* A mean in the scale of a whole block's value: raw LSB times 2^y. */
static uint32_t
scaled_mean(const struct induction *u, uint32_t sum, uint16_t count)
{
    if (!count)
        return sum;
    return ((sum / count) << u->oversample.config.y) + ((sum % count) << u->oversample.config.y) / count;
}

void
command_induction_query(const struct command_args *args)
{
    struct induction *u = oid_lookup((uint8_t)args->val[0], command_config_induction);
    irqstatus_t flag = irq_save();
    uint8_t tripped = u->guard.trip;
    uint32_t sum = tripped ? u->guard.trip_value : u->newest_sum;
    uint16_t count = tripped ? u->guard.trip_count : u->newest_count, phase = u->schedule.commanded;
    irq_restore(flag);
    respond(&response_induction_state, u->oid, timer_read_time(), phase, tripped, scaled_mean(u, sum, count));
}
DECL_COMMAND_FLAGS(command_induction_query, HF_IN_SHUTDOWN, "induction_query oid=%c");

/* With interrupts disabled; may run twice.  Pending phases go back to the pool when the shutdown is cleared. */
void
induction_shutdown(void)
{
    struct induction *u = unit;
    if (!u)
        return;
    switch_off(u);
    phase_forget(&u->schedule);
    u->reporting = 0;
    u->block_tail = u->block_head;
    u->resync = 1;
}
DECL_SHUTDOWN(induction_shutdown);
