/* main(), memory, sleep, watchdog and reset. */
#include <avr/sleep.h>
#include <avr/wdt.h>

#include "board/irq.h"
#include "board/misc.h"
#include "board/watchdog.h"
#include "command.h"
#include "internal.h"
#include "sched.h"

DECL_CONSTANT_STR("MCU", "atmega2560");
DECL_CONSTANT("CLOCK_FREQ", PORT_CLOCK_HZ);

extern uint8_t arena_start[], arena_end[];  /* port.mk: from the end of .bss to the deepest place of the stack */
int main(void);
void reset_watchdog_off(void);

/* After a reset by the watchdog it goes on running, at its shortest time (datasheet 12.4.1): off with it, so that the way to
 * watchdog_start() may take its time.  WDE cannot be cleared while WDRF is set. */
void __attribute__((naked, used, section(".init3")))
reset_watchdog_off(void)
{
    MCUSR = 0;
    wdt_disable();
}

int
main(void)
{
    PRR0 = 1 << PRTWI;                                  /* unused peripherals stand still */
    PRR1 = 1 << PRUSART1 | 1 << PRUSART2 | 1 << PRUSART3;
    ACSR = 1 << ACD;
    set_sleep_mode(SLEEP_MODE_IDLE);
    sleep_enable();
    timer_start();
    console_start();
    sched_main();
    return 0;
}

/* The instruction after sei is executed before any interrupt, so none slips in between. */
void
irq_wait(void)
{
    __asm__ volatile("sei\n\tsleep\n\tcli" ::: "memory");
}

void
watchdog_start(void)
{
    wdt_enable(WDTO_500MS);
}

void
watchdog_feed(void)
{
    wdt_reset();
}

/* There is no other way to reset all peripherals. */
void
board_reset(void)
{
    irq_disable();
    wdt_enable(WDTO_15MS);
    for (;;)
        ;
}

/****************************************************************
 * Memory: what lies between the variables and the stack
 ****************************************************************/

size_t
board_arena(void **start)
{
    *start = arena_start;
    return (size_t)((uintptr_t)arena_end - (uintptr_t)arena_start); /* two symbols of the linker: no array */
}

uint32_t
board_peek(uint8_t order, uint32_t address)
{
    volatile void *at = (void *)(uint16_t)address;
    if (order == 0)
        return *(volatile uint8_t *)at;
    return order == 1 ? *(volatile uint16_t *)at : *(volatile uint32_t *)at;
}

void
board_poke(uint8_t order, uint32_t address, uint32_t value)
{
    volatile void *at = (void *)(uint16_t)address;
    if (order == 0)
        *(volatile uint8_t *)at = (uint8_t)value;
    else if (order == 1)
        *(volatile uint16_t *)at = (uint16_t)value;
    else
        *(volatile uint32_t *)at = value;
}
