/* Board contract: short waits inside task code that makes a waveform by hand (software SPI and I2C, LED chains).
 *
 *   delay_ticks   returns no sooner than `ticks` timer ticks after the call, later if an interrupt comes between.
 *                 Meant for a few microseconds; task context, interrupts enabled or not.
 *
 * The default reads the clock.  A port where that does not work or is too slow defines PORT_DELAY in port_types.h and
 * supplies the function (the simulator: its time stands still while firmware runs).
 */
#ifndef BOARD_DELAY_H
#define BOARD_DELAY_H

#include <stdint.h>

#include "board/timer.h"

#ifdef PORT_DELAY
void delay_ticks(uint32_t ticks);
#else
static inline void
delay_ticks(uint32_t ticks)
{
    uint32_t start = timer_read_time();
    while (timer_read_time() - start < ticks)
        ;
}
#endif

#endif
