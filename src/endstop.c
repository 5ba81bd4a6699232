/* Endstops: watch a pin while homing, and trigger a trsync when it has settled at the wanted level.
 *
 *     every rest_ticks one look ──► level right? ──► sample_count more looks, sample_ticks apart, all right? ──► trigger
 *                       ▲                 no │                                      no │
 *                       └────────────────────┴──────────────────────────────────────────┘
 *
 * endstop_state's next_clock is, while homing, when the next rest look is due; after the trigger, rest_ticks after the first
 * look of the row that triggered: the host takes next_clock - rest_ticks as the clock of the touch.
 */
#include "basecmd.h"
#include "board/gpio.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"
#include "trsync.h"

DECL_RESPONSE(response_endstop_state, "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c");

struct endstop {
    struct timer timer;
    struct gpio_in pin;
    struct trsync *trsync;
    uint32_t sample_ticks, rest_ticks;
    uint32_t next_clock;        /* of the next look of the slow rhythm */
    uint8_t sample_count, confirmed;
    uint8_t wanted_level, trigger_reason, homing;
};

/* Timer.  Every rest_ticks (some 10 us to 1 ms), then every sample_ticks; a few dozen cycles. */
static uint8_t
endstop_event(struct timer *t)
{
    struct endstop *e = container_of(t, struct endstop, timer);
    uint8_t right = gpio_in_read(e->pin) == e->wanted_level;
    uint8_t first_look = !e->confirmed;
    if (first_look)
        e->next_clock = t->waketime + e->rest_ticks;
    if (!right) {
        e->confirmed = 0;
        if (!timer_is_before(t->waketime, e->next_clock))  /* a row longer than the rest: the rhythm starts anew */
            e->next_clock = t->waketime + e->rest_ticks;
        t->waketime = e->next_clock;
        return SF_RESCHEDULE;
    }
    if (e->confirmed == e->sample_count) {
        e->homing = 0;
        trsync_do_trigger(e->trsync, e->trigger_reason);
        return SF_DONE;
    }
    e->confirmed++;
    t->waketime += e->sample_ticks;
    return SF_RESCHEDULE;
}

void
command_config_endstop(const struct command_args *args)
{
    struct endstop *e = oid_alloc((uint8_t)args->val[0], command_config_endstop, sizeof(*e));
    e->pin = gpio_in_setup(args->val[1], (int8_t)args->val[2]);
    e->timer.func = endstop_event;
}
DECL_COMMAND(command_config_endstop, "config_endstop oid=%c pin=%c pull_up=%c");

void
command_endstop_home(const struct command_args *args)
{
    struct endstop *e = oid_lookup((uint8_t)args->val[0], command_config_endstop);
    irqstatus_t flag = irq_save();
    sched_del_timer(&e->timer);
    e->homing = 0;
    e->sample_count = (uint8_t)args->val[3];
    if (e->sample_count) {
        e->timer.waketime = e->next_clock = args->val[1];
        e->sample_ticks = args->val[2];
        e->rest_ticks = args->val[4];
        e->wanted_level = !!args->val[5];
        e->trsync = trsync_lookup((uint8_t)args->val[6]);
        e->trigger_reason = (uint8_t)args->val[7];
        e->confirmed = 0;
        e->homing = 1;
        sched_add_timer(&e->timer);
    }
    irq_restore(flag);
}
DECL_COMMAND(command_endstop_home,
             "endstop_home oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u pin_value=%c"
             " trsync_oid=%c trigger_reason=%c");

void
command_endstop_query_state(const struct command_args *args)
{
    uint8_t oid = (uint8_t)args->val[0];
    struct endstop *e = oid_lookup(oid, command_config_endstop);
    irqstatus_t flag = irq_save();
    uint8_t homing = e->homing;
    uint32_t next_clock = e->next_clock;
    irq_restore(flag);
    respond(&response_endstop_state, oid, homing, next_clock, gpio_in_read(e->pin));
}
DECL_COMMAND(command_endstop_query_state, "endstop_query_state oid=%c");

void
endstop_shutdown(void)
{
    uint8_t i;
    struct endstop *e;
    foreach_oid(i, e, command_config_endstop)
        e->homing = 0;
}
DECL_SHUTDOWN(endstop_shutdown);
