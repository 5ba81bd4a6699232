/* The simulated chip's clock, main loop, console and memory.
 *
 * Booting again.  Nothing of the firmware is in a register or a thread, so a reset is: forget the past (clock, receive buffer,
 * arena — here; every other file in its DECL_INIT function, as src/command.h demands) and call sched_boot().  A test
 * compares all static data of a library booted again with that of a fresh one.
 */
#include <string.h>

#include "board/console.h"
#include "board/delay.h"
#include "board/irq.h"
#include "board/misc.h"
#include "board/timer.h"
#include "board/watchdog.h"
#include "command.h"
#include "sched.h"
#include "sim_internal.h"

DECL_CONSTANT_STR("MCU", "simulator");
DECL_CONSTANT("CLOCK_FREQ", PORT_CLOCK_HZ);
DECL_CONSTANT("SERIAL_BAUD", 250000);
DECL_CONSTANT("RECEIVE_WINDOW", 192);

struct sim_board sim_board;
uint64_t sim_clock;

enum power { POWER_OFF, POWER_ON, POWER_RESETTING, POWER_RESET };

static struct {
    enum power power;
    uint8_t timers_changed;
    uint32_t waited_ticks;           /* in delay_ticks(), by the task pass under way */
    uint64_t timer_clock;            /* of the first timer; valid if !timers_changed */
    uint8_t rx[SIM_RX_SIZE];
    uint32_t rx_read, rx_written;    /* running counts; indices are these modulo SIM_RX_SIZE */
    uint8_t ram[SIM_RAM_SIZE];       /* for debug_read and debug_write */
    _Alignas(16) uint8_t arena[SIM_ARENA_SIZE];
} chip;

/****************************************************************
 * Board contract
 ****************************************************************/

uint32_t
timer_read_time(void)
{
    return (uint32_t)sim_now();
}

uint64_t
sim_now(void)
{
    return sim_clock + chip.waited_ticks;
}

/* A task sees its own waiting, so that waves made by hand have the right shape; the rest of the world does not: the next
 * event comes at its own clock, as if the wait had taken no time. */
void
delay_ticks(uint32_t ticks)
{
    chip.waited_ticks += ticks;
}

void
timer_kick(void)
{
    chip.timers_changed = 1;
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

uint8_t
console_read(uint8_t *byte)
{
    if (chip.rx_read == chip.rx_written)
        return 0;
    *byte = chip.rx[chip.rx_read++ % SIM_RX_SIZE];
    return 1;
}

void
console_send(const uint8_t *block, uint8_t len)
{
    sim_board.console_send(sim_board.ctx, block, len, sim_clock);
}

size_t
board_arena(void **start)
{
    *start = chip.arena;
    return sizeof(chip.arena);
}

void
board_reset(void)
{
    chip.power = POWER_RESETTING;
}

uint32_t
board_peek(uint8_t order, uint32_t address)
{
    uint32_t value = 0;
    uint32_t size = 1u << (order & 3);
    if (order <= 2 && address <= SIM_RAM_SIZE - size)
        memcpy(&value, chip.ram + address, size);
    return value;
}

void
board_poke(uint8_t order, uint32_t address, uint32_t value)
{
    uint32_t size = 1u << (order & 3);
    if (order <= 2 && address <= SIM_RAM_SIZE - size)
        memcpy(chip.ram + address, &value, size);
}

/****************************************************************
 * Time
 ****************************************************************/

static uint64_t
next_timer(void)
{
    if (chip.timers_changed) {
        int32_t ahead = (int32_t)(sched_next_waketime() - (uint32_t)sim_clock);
        chip.timer_clock = ahead > 0 ? sim_clock + (uint64_t)ahead : sim_clock;
        chip.timers_changed = 0;
    }
    return chip.timer_clock;
}

static uint64_t
next_event(void)
{
    uint64_t timer = next_timer(), bridge = sim_bridge_next_event();
    return bridge < timer ? bridge : timer;
}

/* Tasks that wake one another run on; one that wakes itself for ever would hang, so the number of passes is bounded (what
 * is left waits for the next event, as on a board that is busy). */
static void
run_tasks(void)
{
    for (uint8_t pass = 0; pass < 10 && sched_tasks_waiting() && chip.power == POWER_ON; pass++) {
        sched_run_tasks();
        chip.waited_ticks = 0;
    }
}

uint64_t
sim_mcu_next_event(void)
{
    if (chip.power != POWER_ON)
        return SIM_NEVER;
    if (sched_tasks_waiting())
        return sim_clock;
    return next_event();
}

void
sim_mcu_advance(uint64_t clock)
{
    run_tasks();
    while (chip.power == POWER_ON) {
        uint64_t next = next_event();
        if (next > clock)
            break;
        if (next > sim_clock)
            sim_clock = next;
        sim_bridge_run();
        if (next_timer() <= sim_clock) {
            sched_timer_dispatch();
            chip.timers_changed = 1;
        }
        run_tasks();
    }
    if (clock > sim_clock)
        sim_clock = clock;
}

void
sim_mcu_receive(const uint8_t *data, uint32_t len)
{
    if (chip.power != POWER_ON)
        return;
    for (; len && chip.rx_written - chip.rx_read < SIM_RX_SIZE; len--)
        chip.rx[chip.rx_written++ % SIM_RX_SIZE] = *data++;
    command_wake();
}

int
sim_mcu_take_reset(void)
{
    int asked = chip.power == POWER_RESETTING;
    if (asked)
        chip.power = POWER_RESET;
    return asked;
}

void
sim_mcu_boot(const struct sim_board *board, uint64_t clock)
{
    memset(&chip, 0, sizeof(chip));
    sim_board = *board;
    sim_clock = clock;
    chip.power = POWER_ON;
    chip.timers_changed = 1;
    sched_boot();
}
