/* Buttons, encoders, switches: up to eight pins looked at together, changes reported to the host without loss.
 *
 *     every rest_ticks: read all pins ─► the same twice in a row, and new? ─► append to `reports` ─► send
 *
 * A state is one byte, bit i = pin i, exclusive-or'ed with the query's `invert` mask.  Nothing is reported as long as
 * all bits are 0 from the start.  States not yet acknowledged (buttons_ack) are sent again, together, every
 * retransmit_count looks; ack_count is the running number of the first of them, modulo 256.  When REPORTS_MAX states wait
 * for a silent host, newer ones replace the last, so that at least the present state is right.
 */
#include <string.h>

#include "basecmd.h"
#include "board/gpio.h"
#include "board/irq.h"
#include "command.h"
#include "sched.h"

DECL_RESPONSE(response_buttons_state, "buttons_state oid=%c ack_count=%c state=%*s");

enum { BUTTONS_MAX = 8, REPORTS_MAX = 8 };

struct buttons {
    struct timer timer;
    uint32_t rest_ticks;
    uint8_t last_look, reported;           /* newest reading; newest state in a report */
    uint8_t invert;
    uint8_t ack_count;                 /* running number of reports[0] */
    uint8_t reports[REPORTS_MAX], report_count;
    uint8_t looks_to_send;             /* until the reports are sent (again) */
    uint8_t retransmit_count;
    uint8_t send_due;
    uint8_t button_count, added;       /* added: a bit per pin that buttons_add has set up */
    struct gpio_in pins[];
};

static struct task_wake buttons_wake;

void
buttons_init(void)
{
    sched_check_wake(&buttons_wake);
}
DECL_INIT(buttons_init);

static void
note_state(struct buttons *b, uint8_t state)
{
    b->reported = state;
    if (b->report_count < REPORTS_MAX)
        b->report_count++;
    b->reports[b->report_count - 1] = state;
    b->looks_to_send = 0;
}

/* Timer, every 1 to 5 ms; late: the rhythm shifts. */
static uint8_t
buttons_event(struct timer *t)
{
    struct buttons *b = container_of(t, struct buttons, timer);
    uint8_t look = b->invert;
    for (uint8_t i = 0; i < b->button_count; i++)
        if (b->added >> i & 1)
            look ^= (uint8_t)(gpio_in_read(b->pins[i]) << i);
    if (look == b->last_look && look != b->reported)
        note_state(b, look);
    b->last_look = look;
    if (b->report_count) {
        if (!b->looks_to_send) {
            b->looks_to_send = b->retransmit_count;
            b->send_due = 1;
            sched_wake_task(&buttons_wake);
        }
        b->looks_to_send--;
    }
    t->waketime += b->rest_ticks;
    return SF_RESCHEDULE;
}

void
command_config_buttons(const struct command_args *args)
{
    uint32_t count = args->val[1];
    if (count > BUTTONS_MAX)
        shutdown(SHUTDOWN_BUTTONS_MAX);
    uint16_t size = (uint16_t)(sizeof(struct buttons) + count * sizeof(struct gpio_in));
    struct buttons *b = oid_alloc((uint8_t)args->val[0], command_config_buttons, size);
    b->button_count = (uint8_t)count;
    b->timer.func = buttons_event;
}
DECL_COMMAND(command_config_buttons, "config_buttons oid=%c button_count=%c");

static struct buttons *
buttons_lookup(const struct command_args *args)
{
    return oid_lookup((uint8_t)args->val[0], command_config_buttons);
}

void
command_buttons_add(const struct command_args *args)
{
    struct buttons *b = buttons_lookup(args);
    if (args->val[1] >= b->button_count)
        shutdown(SHUTDOWN_BUTTONS_POSITION);
    b->pins[args->val[1]] = gpio_in_setup(args->val[2], (int8_t)args->val[3]);
    b->added |= (uint8_t)(1 << args->val[1]);
}
DECL_COMMAND(command_buttons_add, "buttons_add oid=%c pos=%c pin=%u pull_up=%c");

void
command_buttons_query(const struct command_args *args)
{
    struct buttons *b = buttons_lookup(args);
    irqstatus_t flag = irq_save();
    sched_del_timer(&b->timer);
    b->timer.waketime = args->val[1];
    b->rest_ticks = args->val[2];
    b->retransmit_count = (uint8_t)args->val[3];
    b->invert = (uint8_t)args->val[4];
    b->ack_count = b->report_count = b->send_due = 0;
    b->last_look = b->reported = 0;
    if (b->rest_ticks) {
        if (!b->retransmit_count)
            shutdown(SHUTDOWN_BUTTONS_RETRANSMIT);
        sched_add_timer(&b->timer);
    }
    irq_restore(flag);
}
DECL_COMMAND(command_buttons_query, "buttons_query oid=%c clock=%u rest_ticks=%u retransmit_count=%c invert=%c");

void
command_buttons_ack(const struct command_args *args)
{
    struct buttons *b = buttons_lookup(args);
    uint8_t count = (uint8_t)args->val[1];
    irqstatus_t flag = irq_save();
    if (count > b->report_count)
        count = b->report_count;
    b->ack_count = (uint8_t)(b->ack_count + count);
    b->report_count = (uint8_t)(b->report_count - count);
    memmove(b->reports, b->reports + count, b->report_count);
    irq_restore(flag);
}
DECL_COMMAND(command_buttons_ack, "buttons_ack oid=%c count=%c");

void
buttons_task(void)
{
    uint8_t i;
    struct buttons *b;
    if (!sched_check_wake(&buttons_wake))
        return;
    foreach_oid(i, b, command_config_buttons) {
        uint8_t reports[REPORTS_MAX];
        irqstatus_t flag = irq_save();
        uint8_t due = b->send_due, ack_count = b->ack_count;
        unsigned int count = b->report_count;
        b->send_due = 0;
        memcpy(reports, b->reports, sizeof(reports));
        irq_restore(flag);
        if (due && count)
            respond(&response_buttons_state, (uint8_t)(i - 1), ack_count, count, reports);
    }
}
DECL_TASK(buttons_task);
