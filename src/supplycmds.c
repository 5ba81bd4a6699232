/* A switch in a heater's supply that is closed only while this MCU is healthy: what still turns off a heater whose
 * transistor conducts all the time.
 *
 *     configured ─► closed ─► any shutdown, a reset, a stopped chip ─► open until configured again
 *
 * Level (interval 0): the pin is active while closed.  A chip that stops leaves it so until the watchdog resets it; pins then
 * float, and a resistor at the switch must hold it open.
 * Edges (interval > 0): the pin changes each interval, and only if the watchdog has been fed since the last edge (sched.h: tasks,
 * timers, samples).  A switch that wants edges (a charge pump, a retriggerable monostable) opens with any of them.
 */
#include "basecmd.h"
#include "board/gpio.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"

enum { INTERVAL_MIN_US = 1000 }; /* three of the samples' interrupts */

struct supply_switch {
    struct timer timer; /* at the next edge */
    struct gpio_out pin;
    uint32_t interval;
    uint8_t open_level, feeds;
};

static struct task_wake supply_wake; /* a pass of the tasks between two edges: nothing else may happen in that time */

/* Timer, each interval. */
static uint8_t
supply_edge(struct timer *t)
{
    struct supply_switch *s = container_of(t, struct supply_switch, timer);
    uint8_t feeds = sched_watchdog_feeds();
    if (feeds != s->feeds)
        gpio_out_toggle(s->pin);
    s->feeds = feeds;
    sched_wake_task(&supply_wake);
    t->waketime += s->interval;
    return SF_RESCHEDULE;
}

void
supply_task(void)
{
    sched_check_wake(&supply_wake);
}
DECL_TASK(supply_task);

void
command_config_supply_switch(const struct command_args *args)
{
    struct supply_switch *s = oid_alloc((uint8_t)args->val[0], command_config_supply_switch, sizeof(*s));
    s->open_level = args->val[2] == 0;
    s->interval = args->val[3];
    if (s->interval && s->interval < timer_from_us(INTERVAL_MIN_US))
        shutdown(SHUTDOWN_SUPPLY_SWITCH);
    s->pin = gpio_out_setup(args->val[1], s->interval ? s->open_level : !s->open_level);
    if (!s->interval)
        return;
    s->timer.func = supply_edge;
    s->timer.waketime = timer_read_time() + s->interval;
    sched_add_timer(&s->timer);
}
DECL_COMMAND(command_config_supply_switch, "config_supply_switch oid=%c pin=%u active=%c interval=%u");

void
supply_shutdown(void)
{
    struct supply_switch *s;
    uint8_t i;
    foreach_oid(i, s, command_config_supply_switch) {
        gpio_out_write(s->pin, s->open_level);
    }
}
DECL_SHUTDOWN(supply_shutdown);
