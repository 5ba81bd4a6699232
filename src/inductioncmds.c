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
#include "block_record.h"
#include "board/bridge_pwm.h"
#include "board/irq.h"
#include "board/sync_adc.h"
#include "board/timer.h"
#include "command.h"
#include "induction_unit.h"
#include "sched.h"

enum {
    DATA_SIZE_MAX = 48,  /* what fits one message: 7 plain records, 3 of the longest */
    TEST_AHEAD = 4,      /* samples between planning a test and its first; a timer needs 10 us */
    SAMPLES_MISSING_MAX = 2 * HALF_LEN + 64, /* a half buffer that is only late counts as a gap */
    CHECK_US = 4000,     /* so often it is looked whether samples come */
    LATE_MARGIN_US = 20, /* a late phase command is applied so much after its arrival */
};

DECL_ENUMERATION("induction_trip", "none", GUARD_TRIP_NONE);
DECL_ENUMERATION("induction_trip", "low", GUARD_TRIP_LOW);
DECL_ENUMERATION("induction_trip", "high", GUARD_TRIP_HIGH);
DECL_ENUMERATION("induction_trip", "clipped", GUARD_TRIP_CLIPPED);
DECL_ENUMERATION("induction_trip", "stuck", GUARD_TRIP_STUCK);
DECL_ENUMERATION("induction_trip", "timeout", GUARD_TRIP_TIMEOUT);
DECL_ENUMERATION("induction_trip", "unmoved", GUARD_TRIP_UNMOVED);
DECL_ENUMERATION("induction_trip", "conducts", GUARD_TRIP_CONDUCTS);
DECL_ENUMERATION("induction_trip", "jump", GUARD_TRIP_JUMP);

DECL_RESPONSE(response_induction_state, "induction_state oid=%c clock=%u phase=%hu trip=%c value=%u moved=%hu");
DECL_RESPONSE(response_induction_block, "induction_block oid=%c sequence=%hu clock=%u data=%*s");

static struct induction *unit;  /* the one induction heater of this MCU; induction_samples gets no object */
static struct task_wake report_wake;

void
induction_init(void)
{
    unit = NULL;
    report_wake.wake = 0;
}
DECL_INIT(induction_init);

struct induction *
induction_unit(void)
{
    return unit;
}

void
induction_use(struct induction *u)
{
    unit = u;
}

/****************************************************************
 * Phases (timer context)
 ****************************************************************/

#ifdef PORT_SYNC_ADC_FIXED
#define sync_adc_move(adc, ticks) ((void)0)
#endif

/* A test under way ends without a verdict: the drive steps. */
static void
cancel_test(struct induction *u)
{
    uint16_t settle = u->oversample.config.settle_samples;
    sched_del_timer(&u->test_timer);
    if (signal_test_cancel(&u->test, sync_adc_position(u->adc), settle) == SIGNAL_TEST_MOVE)
        sync_adc_move(u->adc, 0);
}

static void
apply_phase(struct induction *u, uint16_t phase, uint32_t clock)
{
    cancel_test(u);
    bridge_pwm_set_phase(u->bridge, phase);
    phase_applied(&u->schedule, sync_adc_position(u->adc), phase);
    guard_fed(&u->guard, clock, phase);
}

/* Any context, interrupts disabled. */
static void
bridge_off(struct induction *u)
{
    cancel_test(u);
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
        [GUARD_TRIP_TIMEOUT] = SHUTDOWN_INDUCTION_TIMEOUT, [GUARD_TRIP_UNMOVED] = SHUTDOWN_INDUCTION_UNMOVED,
        [GUARD_TRIP_CONDUCTS] = SHUTDOWN_INDUCTION_CONDUCTS, [GUARD_TRIP_JUMP] = SHUTDOWN_INDUCTION_JUMP,
    };
    switch_off(u);
    shutdown(reasons[reason]);
}

static uint32_t
earlier(uint32_t a, uint32_t b)
{
    return timer_is_before(b, a) ? b : a;
}

/* When the timer of phases must run next; 0 if it need not. */
static uint8_t
next_event(const struct induction *u, uint32_t *clock)
{
    const struct phase_node *pending = u->schedule.first;
    if (!pending && !guard_is_waiting(&u->guard))
        return 0;
    *clock = pending ? pending->due : guard_deadline(&u->guard);
    if (guard_is_waiting(&u->guard))
        *clock = earlier(*clock, guard_deadline(&u->guard));
    if (u->guard.powered)
        *clock = earlier(*clock, timer_read_time() + timer_from_us(CHECK_US));
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

/* Without samples nothing judges them. */
static void
check_samples(struct induction *u)
{
    if (!u->guard.powered || sync_adc_position(u->adc) - u->next_index <= SAMPLES_MISSING_MAX)
        return;
    switch_off(u);
    shutdown(SHUTDOWN_SAMPLES_STOPPED);
}

uint8_t
induction_phase_timer(struct timer *t)
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
    check_samples(u);
    return next_event(u, &t->waketime) ? SF_RESCHEDULE : SF_DONE;
}

/****************************************************************
 * Tests of the signal: signal_test.h
 ****************************************************************/

/* The middle of the period before sample `index`: what is set now takes effect with that sample. */
static uint32_t
clock_before(const struct induction *u, uint32_t index)
{
    return u->start_clock + index * u->period_ticks - u->period_ticks / 2;
}

uint8_t
induction_test_timer(struct timer *t)
{
    struct induction *u = container_of(t, struct induction, test_timer);
    uint32_t from = sync_adc_position(u->adc);
    uint8_t move = u->test.kind == SIGNAL_TEST_MOVE, ends = u->test.begun;
    if (move)
        sync_adc_move(u->adc, ends ? 0 : SYNC_ADC_MOVE_TICKS);
    else
        bridge_pwm_set_phase(u->bridge, ends ? u->schedule.commanded : 0);
    if (ends) {
        signal_test_end(&u->test, from, u->oversample.config.settle_samples);
        return SF_DONE;
    }
    signal_test_begin(&u->test, from);
    t->waketime = clock_before(u, from + signal_test_length(&u->test));
    return SF_RESCHEDULE;
}

/* Irq.  A test begins where a block ends, if the samples before it are still to come and the drive does not step
 * until it is over. */
static void
plan_test(struct induction *u)
{
    const struct oversample *o = &u->oversample;
    uint32_t at = u->next_index + o->block_len - o->count;
    if (!signal_test_is_due(&u->test, u->next_index) || o->settle_left || o->phase != u->schedule.commanded ||
        o->phase < u->test.limits.phase)
        return;
    if (at - u->next_index < SIGNAL_TEST_LEN || (int32_t)(at - sync_adc_position(u->adc)) < TEST_AHEAD)
        at += o->block_len;
    uint32_t over = clock_before(u, at + SIGNAL_TEST_OFF_LEN + o->config.settle_samples + SIGNAL_TEST_LEN);
    if (u->schedule.first && timer_is_before(u->schedule.first->due, over))
        return;
    if (signal_test_plan(&u->test, at, o->phase) == SIGNAL_TEST_NONE)
        return;
    u->test_timer.waketime = clock_before(u, at);
    sched_add_timer(&u->test_timer);
}

/****************************************************************
 * Samples (irq context)
 ****************************************************************/

static void
trip_if(struct induction *u, enum guard_trip found, uint32_t value, uint16_t count)
{
    if (found != GUARD_TRIP_NONE && guard_latch(&u->guard, found, value, count) != GUARD_TRIP_NONE)
        trip(u, found);
}

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
    if (u->test.limits.interval)
        trip_if(u, signal_test_block(&u->test, &seen, b->first), b->sum, b->count);
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
        uint8_t skip = 0;
        if (u->test.kind || u->test.begun) {
            skip = signal_test_run(&u->test, u->next_index, run, &run);
            trip_if(u, signal_test_feed(&u->test, samples, u->next_index, run), u->test.inside, SIGNAL_TEST_LEN);
        }
        if (oversample_step(&u->oversample, phase, b)) {
            take_block(u, b);
            b = next_block(u);
        }
        if (skip) {
            if (oversample_skip(&u->oversample, run, b)) {
                take_block(u, b);
                b = next_block(u);
            }
            u->next_index += run;
            count -= run;
            samples += run;
            continue;
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

/* Samples of a test under way are missing: it is undone, without a verdict. */
static void
lose_test(struct induction *u)
{
    uint8_t off = u->test.kind == SIGNAL_TEST_OFF && u->test.begun && !u->test.ended;
    cancel_test(u);
    if (off)
        bridge_pwm_set_phase(u->bridge, u->schedule.commanded);
}

void
induction_samples(const uint16_t *samples, uint16_t count)
{
    struct induction *u = unit;
    sched_report(SCHED_SAMPLES);
    if (!u)
        return;
    uint32_t position = sync_adc_position(u->adc);
    if (u->resync) {
        u->resync = 0;
        u->next_index = newest_end(position) - count;
        oversample_init(&u->oversample, u->oversample.config);
        lose_test(u);
    }
    uint32_t ahead = position - u->next_index;
    if (ahead < count)
        return;  /* part of a gap already reported */
    if (ahead > 2u * HALF_LEN) {
        struct oversample_block *b = next_block(u);
        uint32_t lost = newest_end(position) - u->next_index;
        lose_test(u);
        u->next_index += lost;
        if (oversample_gap(&u->oversample, lost, b))
            take_block(u, b);
    } else {
        take_samples(u, samples, count);
        plan_test(u);
    }
    if (u->reporting && records_to_send(u))
        sched_wake_task(&report_wake);
}

/****************************************************************
 * Reports (task context)
 ****************************************************************/

static uint8_t
saturated(const struct oversample_block *b)
{
    return b->discarded == UINT16_MAX || b->lost == UINT16_MAX;
}

/* One message of as many records as are due and fit. Returns 1 if there may be more. */
static uint8_t
send_report(struct induction *u)
{
    uint8_t data[DATA_SIZE_MAX + BLOCK_RECORD_MAX], *end = data;
    const struct oversample_block *before = NULL;
    irqstatus_t flag = irq_save();
    uint8_t ready = u->reporting ? records_to_send(u) : 0, records = 0;
    uint16_t sequence = u->sequence;
    uint32_t from = u->waiting[u->block_tail & (BLOCKS_WAITING_MAX - 1)].first;
    for (; records < ready; records++) {
        const struct oversample_block *b = &u->waiting[u->block_tail & (BLOCKS_WAITING_MAX - 1)];
        if (before && saturated(b))
            break;
        uint8_t *after = block_record_put(end, b, before, u->oversample.block_len);
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

/* From `phase` on the nozzle may read no higher than `share` of the way between the limits of its row (guard.h). */
void
command_induction_ceiling(const struct command_args *args)
{
    struct induction *u = induction_of(args);
    irqstatus_t flag = irq_save();
    guard_set_ceiling(&u->guard, (uint16_t)args->val[1], (uint16_t)args->val[2]);
    irq_restore(flag);
}
DECL_COMMAND(command_induction_ceiling, "induction_ceiling oid=%c phase=%hu share=%hu");

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
    sched_watch(SCHED_SAMPLES, 1);
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
    struct induction *u = induction_of(args);
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
    struct induction *u = induction_of(args);
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
    struct induction *u = induction_of(args);
    irqstatus_t flag = irq_save();
    uint8_t tripped = u->guard.trip;
    uint32_t sum = tripped ? u->guard.trip_value : u->newest_sum;
    uint16_t count = tripped ? u->guard.trip_count : u->newest_count, phase = u->schedule.commanded;
    uint16_t moved = signal_test_moved(&u->test);
    irq_restore(flag);
    respond(&response_induction_state, u->oid, timer_read_time(), phase, tripped, scaled_mean(u, sum, count), moved);
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
    sched_watch(SCHED_SAMPLES, 0); /* what has stopped shall be reported, not reset */
    phase_forget(&u->schedule);
    u->reporting = 0;
    u->block_tail = u->block_head;
    u->resync = 1;
}
DECL_SHUTDOWN(induction_shutdown);
