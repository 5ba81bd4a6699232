/* sched.c alone on a made-up board, where the test itself is the interrupt: what the simulator, in which nothing ever
 * interrupts, cannot show.  Prints one word per event; test_mcu_sched.py knows the right order. */
#include <stdio.h>

#include "board/irq.h"
#include "board/timer.h"
#include "board/watchdog.h"
#include "command.h"
#include "sched.h"

static uint32_t now = 100;
static uint8_t output;
static const char *scenario;

const struct response response_starting = { 2, "" };
const struct response response_shutdown = { 3, "wu" };
const struct response response_is_shutdown = { 4, "u" };
void sched_announce_task(void);

void
respond(const struct response *r, ...)
{
    printf("respond%d ", r->id);
}

uint32_t
timer_read_time(void)
{
    return now;
}

void
timer_kick(void)
{
}

void
irq_wait(void)
{
}

void
watchdog_start(void)
{
}

void
watchdog_feed(void)
{
}

static uint8_t
stop_event(struct timer *t)
{
    (void)t;
    printf("timer ");
    shutdown(SHUTDOWN_ADC_RANGE);
}

static uint8_t
tick_event(struct timer *t)
{
    printf("tick%u ", (unsigned)t->waketime);
    return SF_DONE;
}

static struct timer stopper = { .func = stop_event, .waketime = 200 };
static struct timer late = { .func = tick_event, .waketime = 300 };

/* A command that is interrupted by a timer that shuts down, and then goes on to switch its output on. */
static void
interrupted_task(void)
{
    sched_add_timer(&stopper);
    now = 200;
    sched_timer_dispatch();  /* the interrupt */
    printf("task-goes-on ");
    output = 1;
    sched_add_timer(&late);  /* must be ignored */
}

static void
failing_task(void)
{
    output = 1;
    shutdown(SHUTDOWN_COMMAND_REQUEST);
}

void
compile_time_init(void)
{
    if (scenario[0] == 'i')
        shutdown(SHUTDOWN_NOT_OUTPUT_PIN);
}

void
compile_time_tasks(void)
{
    static uint8_t done;
    sched_announce_task();
    if (done)
        return;
    done = 1;
    if (scenario[0] == 'n')
        interrupted_task();
    if (scenario[0] == 'f')
        failing_task();
}

void
compile_time_shutdown(void)
{
    output = 0;
    printf("safe ");
}

static void
order_of_timers(void)
{
    static struct timer t[5] = {
        { .waketime = 300 }, { .waketime = 200 }, { .waketime = 300 }, { .waketime = 150 }, { .waketime = 200 },
    };
    for (int i = 0; i < 5; i++) {
        t[i].func = tick_event;
        sched_add_timer(&t[i]);
    }
    sched_del_timer(&t[4]);
    sched_del_timer(&t[4]);
    now = 250;
    printf("next%u ", (unsigned)sched_timer_dispatch());
    now = 300;
    sched_timer_dispatch();
}

int
main(int argc, char **argv)
{
    scenario = argc > 1 ? argv[1] : "";
    sched_boot();
    sched_run_tasks();
    if (scenario[0] == 'o')
        order_of_timers();
    sched_run_tasks();
    now = 400;
    sched_timer_dispatch();
    printf("output%d reason%d\n", output, (int)sched_shutdown_reason());
    return 0;
}
