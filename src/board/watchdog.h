/* Board contract: the watchdog.  It resets the chip, outputs off, when the main loop has not come round for about
 * half a second: longer than any task pass, shorter than it takes a heater to do harm.
 *
 *   watchdog_start   once, at the end of boot
 *   watchdog_feed    after every pass of the main loop
 *
 * A port whose chip has none provides empty functions and says so in its README.
 */
#ifndef BOARD_WATCHDOG_H
#define BOARD_WATCHDOG_H

void watchdog_start(void);
void watchdog_feed(void);

#endif
