/* Slow analog inputs: sampled in groups, summed, checked against a range, reported in batches.
 *
 *     clock                          clock + rest_ticks
 *       |s s s s                       |s s s s                sample_count samples, sample_ticks apart
 *       └──┬───┘ value = their sum     └──┬───┘
 *
 * A value is the plain sum (the host divides by sample_count * ADC_MAX, and keeps that product below 65536; a larger sum is
 * taken as 65535).  It must lie in min_value..max_value; the range_check_count-th value in a row that does not shuts down
 * with "ADC out of range".
 *
 * analog_in_state carries values as 16 bits, low byte first.  Values are gathered until they fill bytes_per_report bytes
 * (2: every value by itself) and then sent, with next_clock = when the next group begins: the last value of the report was
 * begun rest_ticks before it, the one before that 2 * rest_ticks, ...  sample_count = 0 stops the sampling.
 *
 * CONFIG_SINGLE_ANALOG_REPORTS: both messages as hosts before 2025 know them, without bytes_per_report and with one value.
 */
#include <string.h>

#include "analog_in.h"
#include "basecmd.h"
#include "board/adc.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"

#ifdef CONFIG_SINGLE_ANALOG_REPORTS
DECL_RESPONSE(response_analog_in_state, "analog_in_state oid=%c next_clock=%u value=%hu");
enum { ARG_BYTES = -1, ARG_RANGE = 5 }; /* places of query_analog_in's later parameters */
#else
DECL_RESPONSE(response_analog_in_state, "analog_in_state oid=%c next_clock=%u values=%*s");
enum { ARG_BYTES = 5, ARG_RANGE = 6 };
#endif

/* A message holds 59 bytes: id 2, oid 2, clock 5, length 1 leave 49. */
enum { REPORT_BYTES_MAX = 48 };

struct analog_in {
    struct timer timer;
    struct analog_listener *listener;
    struct adc_in pin;
    uint32_t group_clock;                  /* of the first sample of the group under way, or of the next */
    uint32_t sample_ticks, rest_ticks;
    uint16_t min_value, max_value, sum;
    uint8_t sample_count, samples_taken;
    uint8_t range_check_count, out_of_range;     /* values out of range in a row */
    uint8_t report_bytes, filled;
    uint8_t report_ready;
    uint8_t values[REPORT_BYTES_MAX], report[REPORT_BYTES_MAX];
    uint32_t report_next_clock;
};

static struct task_wake analog_wake;

void
analog_init(void)
{
    sched_check_wake(&analog_wake);
}
DECL_INIT(analog_init);

static void
check_range(struct analog_in *a)
{
    if (a->sum >= a->min_value && a->sum <= a->max_value) {
        a->out_of_range = 0;
        return;
    }
    if (a->out_of_range < UINT8_MAX)
        a->out_of_range++;
    if (a->out_of_range >= a->range_check_count)
        shutdown(SHUTDOWN_ADC_RANGE);
}

/* A value is complete; group_clock is already that of the next group. */
static void
store_value(struct analog_in *a)
{
    a->values[a->filled++] = (uint8_t)a->sum;
    a->values[a->filled++] = (uint8_t)(a->sum >> 8);
    if (a->filled < a->report_bytes)
        return;
    memcpy(a->report, a->values, a->filled);
    a->filled = 0;
    a->report_next_clock = a->group_clock;
    a->report_ready = 1;
    sched_wake_task(&analog_wake);
}

/* Timer; once or twice a sample (start the conversion, fetch it).  Late: the samples of a group come closer together, groups
 * keep their clocks. */
static uint8_t
analog_event(struct timer *t)
{
    struct analog_in *a = container_of(t, struct analog_in, timer);
    uint32_t wait = adc_poll(a->pin);
    if (wait) {
        t->waketime += wait;
        return SF_RESCHEDULE;
    }
    uint16_t code = adc_take(a->pin);
    a->sum = code > UINT16_MAX - a->sum ? UINT16_MAX : (uint16_t)(a->sum + code);
    if (++a->samples_taken < a->sample_count) {
        t->waketime += a->sample_ticks;
        return SF_RESCHEDULE;
    }
    check_range(a);
    if (a->listener)
        a->listener->on_value(a->listener, a->sum);
    a->group_clock += a->rest_ticks;
    store_value(a);
    a->sum = a->samples_taken = 0;
    t->waketime = a->group_clock;
    return SF_RESCHEDULE;
}

void
command_config_analog_in(const struct command_args *args)
{
    struct analog_in *a = oid_alloc((uint8_t)args->val[0], command_config_analog_in, sizeof(*a));
    a->pin = adc_setup(args->val[1]);
    a->timer.func = analog_event;
}
DECL_COMMAND(command_config_analog_in, "config_analog_in oid=%c pin=%u");

void
analog_in_listen(uint8_t oid, struct analog_listener *l)
{
    struct analog_in *a = oid_lookup(oid, command_config_analog_in);
    irqstatus_t flag = irq_save();
    a->listener = l;
    irq_restore(flag);
}

void
command_query_analog_in(const struct command_args *args)
{
    struct analog_in *a = oid_lookup((uint8_t)args->val[0], command_config_analog_in);
    uint32_t report_bytes = ARG_BYTES < 0 ? 2 : args->val[ARG_BYTES < 0 ? 0 : ARG_BYTES];
    irqstatus_t flag = irq_save();
    sched_del_timer(&a->timer);
    adc_cancel(a->pin);
    a->timer.waketime = a->group_clock = args->val[1];
    a->sample_ticks = args->val[2];
    a->sample_count = (uint8_t)args->val[3];
    a->rest_ticks = args->val[4];
    a->min_value = (uint16_t)args->val[ARG_RANGE];
    a->max_value = (uint16_t)args->val[ARG_RANGE + 1];
    a->range_check_count = (uint8_t)args->val[ARG_RANGE + 2];
    a->sum = a->samples_taken = a->out_of_range = a->filled = a->report_ready = 0;
    if (a->sample_count) {
        if (report_bytes < 2 || report_bytes > REPORT_BYTES_MAX || report_bytes % 2)
            shutdown(SHUTDOWN_ADC_REPORT_SIZE);
        a->report_bytes = (uint8_t)report_bytes;
        sched_add_timer(&a->timer);
    }
    irq_restore(flag);
}
#ifdef CONFIG_SINGLE_ANALOG_REPORTS
DECL_COMMAND(command_query_analog_in,
             "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u"
             " min_value=%hu max_value=%hu range_check_count=%c");
#else
DECL_COMMAND(command_query_analog_in,
             "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u bytes_per_report=%c"
             " min_value=%hu max_value=%hu range_check_count=%c");
#endif

static void
send_state(uint8_t oid, uint32_t next_clock, const uint8_t *report, uint8_t len)
{
#ifdef CONFIG_SINGLE_ANALOG_REPORTS
    (void)len;
    respond(&response_analog_in_state, oid, next_clock, (uint16_t)(report[0] | report[1] << 8));
#else
    respond(&response_analog_in_state, oid, next_clock, (unsigned int)len, report);
#endif
}

void
analog_task(void)
{
    uint8_t i;
    struct analog_in *a;
    if (!sched_check_wake(&analog_wake))
        return;
    foreach_oid(i, a, command_config_analog_in) {
        uint8_t report[REPORT_BYTES_MAX];
        irqstatus_t flag = irq_save();
        uint8_t ready = a->report_ready;
        uint32_t next_clock = a->report_next_clock;
        a->report_ready = 0;
        memcpy(report, a->report, sizeof(report));
        irq_restore(flag);
        if (ready)
            send_state((uint8_t)(i - 1), next_clock, report, a->report_bytes);
    }
}
DECL_TASK(analog_task);

void
analog_shutdown(void)
{
    uint8_t i;
    struct analog_in *a;
    foreach_oid(i, a, command_config_analog_in) {
        adc_cancel(a->pin);
        a->report_ready = 0;
    }
}
DECL_SHUTDOWN(analog_shutdown);
