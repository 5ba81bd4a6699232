/* Configuration of the induction heater: once, before its first use. */
#include "basecmd.h"
#include "board/timer.h"
#include "command.h"
#include "induction_timing.h"
#include "induction_unit.h"

enum {
    SYNC_ADC_MAX = 4095,    /* the synchronous ADC has 12 bits on every port */
    RECORDS_MAX = 7,
    SILENCE_US = 3000000,   /* a host that is silent for longer is dead; queued motion lasts no longer */
    LONE_RECORD_US = 20000, /* a record that would wait longer for others goes without them */
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
DECL_CONSTANT("INDUCTION_TEST_SAMPLES", SIGNAL_TEST_LEN);
#ifndef PORT_SYNC_ADC_FIXED
DECL_CONSTANT("INDUCTION_MOVE_TICKS", SYNC_ADC_MOVE_TICKS);
#endif

void
command_config_induction(const struct command_args *args)
{
    struct induction *u = oid_alloc((uint8_t)args->val[0], command_config_induction, sizeof(*u));
    uint32_t period_ticks = args->val[3], phase_max = args->val[4], max_duration = args->val[5];
    /* Half the clock's range: a deadline must be tellable from the past. */
    if (induction_unit() || phase_max > BRIDGE_PHASE_MAX || !max_duration || max_duration > INT32_MAX / 2)
        shutdown(SHUTDOWN_INDUCTION_CONFIG);
    u->oid = (uint8_t)args->val[0];
    u->bridge = bridge_pwm_setup((uint8_t)args->val[1], period_ticks);
    u->adc = sync_adc_setup(args->val[2], u->bridge, HALF_LEN, induction_samples);
    u->period_ticks = period_ticks;
    u->hold_samples = timer_from_us(LONE_RECORD_US) / period_ticks;
    u->records = INDUCTION_RECORDS;
    u->timer.func = induction_phase_timer;
    u->test_timer.func = induction_test_timer;
    signal_test_init(&u->test);
    phase_init(&u->schedule, (uint16_t)phase_max);
    guard_init(&u->guard, SYNC_ADC_MAX, max_duration, timer_from_us(SILENCE_US));
    oversample_init(&u->oversample, (struct oversample_config){.y = INDUCTION_OVERSAMPLE,
                                                                .settle_samples = INDUCTION_SETTLE_SAMPLES,
                                                                .block_len = INDUCTION_BLOCK_SAMPLES});
    move_request_size(sizeof(struct phase_node));
    induction_use(u);
}
DECL_COMMAND(command_config_induction,
             "config_induction oid=%c bridge=%c adc_pin=%u period_ticks=%u phase_max=%hu max_duration=%u");

struct induction *
induction_of(const struct command_args *args)
{
    return oid_lookup((uint8_t)args->val[0], command_config_induction);
}

void
command_config_induction_sense(const struct command_args *args)
{
    struct induction *u = induction_of(args);
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
    struct induction *u = induction_of(args);
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
    struct induction *u = induction_of(args);
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

void
command_config_induction_test(const struct command_args *args)
{
    struct induction *u = induction_of(args);
    struct signal_test_limits limits = {
        .moved_low = (uint16_t)args->val[1],
        .moved_high = (uint16_t)args->val[2],
        .off_low = (uint16_t)args->val[3],
        .off_high = (uint16_t)args->val[4],
        .interval = (uint16_t)args->val[5],
        .phase = (uint16_t)args->val[6],
        .jump = (uint16_t)args->val[7],
        .rise = (uint16_t)args->val[8],
        .fall = (uint16_t)args->val[9],
        .tolerance = (uint8_t)args->val[10],
        .slack = (uint16_t)args->val[11],
    };
#ifdef PORT_SYNC_ADC_FIXED
    limits.moved_low = limits.moved_high = 0;
#endif
    if (u->sampling || !signal_test_configure(&u->test, limits))
        shutdown(SHUTDOWN_INDUCTION_CONFIG);
}
DECL_COMMAND(command_config_induction_test,
             "config_induction_test oid=%c moved_low=%hu moved_high=%hu off_low=%hu off_high=%hu interval=%hu phase=%hu"
             " jump=%hu rise=%hu fall=%hu tolerance=%c slack=%hu");
