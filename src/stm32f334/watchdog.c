/* The independent watchdog, on the 40 kHz oscillator of its own (30 to 50 kHz by DS9994): 1250 counts of 16 are 0.5 s, 0.4 at
 * the fastest.  A chip whose PLL does not start is nine times as slow, and so are its wake-ups: 1250 counts of 128 are 4 s
 * (it only reports to the host what is wrong). */
#include "board/watchdog.h"
#include "internal.h"

enum { KEY_FEED = 0xaaaa, KEY_UNLOCK = 0x5555, KEY_START = 0xcccc, PRESCALER_16 = 2, PRESCALER_128 = 5, COUNTS = 1250 };

void
watchdog_start(void)
{
    IWDG_KR = KEY_START;
    IWDG_KR = KEY_UNLOCK;
    IWDG_PR = clock_hz() > 8000000 ? PRESCALER_16 : PRESCALER_128;
    IWDG_RLR = COUNTS - 1;
    for (unsigned spin = 0; spin < 10000 && IWDG_SR & (IWDG_SR_PVU | IWDG_SR_RVU); spin++)
        ;
    IWDG_KR = KEY_FEED;
}

void
watchdog_feed(void)
{
    IWDG_KR = KEY_FEED;
}
