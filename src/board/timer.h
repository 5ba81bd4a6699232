/* Board contract: the clock and the timer interrupt.
 *
 * One free running 32-bit count at PORT_CLOCK_HZ (port_types.h; exported to the host as CLOCK_FREQ) is the only time
 * there is.  It wraps; the host extends it to 64 bits and never schedules 2^31 ticks or more ahead.  A chip with a
 * 16-bit timer extends it in its port.
 *
 *   timer_read_time   now; any context; must never step back
 *   timer_read_low    its low bits, as timer_low_t; timer functions only.  A port that reads them faster than the whole
 *                     clock defines PORT_TIMER_LOW, the type and the function
 *   timer_kick        any context, interrupts disabled: the first timer of the list has changed.  The port makes its
 *                     timer interrupt fire at sched_next_waketime(), at once if that has passed.
 *
 * The timer interrupt calls sched_timer_dispatch() and sets itself for the clock that returns.
 *
 * port_types.h may define, all in ticks and none of them on a port whose time stands still while code runs:
 *
 *   PORT_TIMER_WAIT_TICKS    the next timer is waited for inside the interrupt if it is nearer (leaving and coming again
 *                            takes longer)
 *   PORT_TIMER_PAUSE_TICKS   what tasks get now and then when timers would leave them nothing
 *   PORT_SHORT_PULSE_TICKS   step pulses up to this long are ended within the same event
 *   PORT_TIMER_INTERVAL_TICKS  timers are run for so long, then other interrupts and tasks get their turn; 96 us
 *   PORT_TIMER_NEAR          on a processor of 8 bits: sched_near.h.  The port defines PORT_TIMER_LOW with 16 bits,
 *                            timer_read_byte() (the lowest eight) and timer_half_t (16 bits that may be half of a clock)
 *
 * and, where the compiler makes more than a comparison and a branch of it, PORT_TIMER_IS_BEFORE and that function.
 */
#ifndef BOARD_TIMER_H
#define BOARD_TIMER_H

#include <stdint.h>

#include "port_types.h"

uint32_t timer_read_time(void);
#ifndef PORT_TIMER_LOW
typedef uint32_t timer_low_t;
static inline timer_low_t
timer_read_low(void)
{
    return timer_read_time();
}
#endif
void timer_kick(void);

static inline uint32_t
timer_from_us(uint32_t us)
{
    return us * (PORT_CLOCK_HZ / 1000000u);
}

/* Is clock a earlier than clock b?  True order for clocks less than 2^31 ticks apart. */
#ifndef PORT_TIMER_IS_BEFORE
static inline uint8_t
timer_is_before(uint32_t a, uint32_t b)
{
    return (int32_t)(a - b) < 0;
}
#endif

#endif
