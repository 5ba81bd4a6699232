/* The watchdog as a means of reset (datasheet 12.4): 128 kHz, a change of its time in two steps four cycles apart. */
#include <string.h>

#include "chip.h"

enum { WDE = 1 << 3, WDCE = 1 << 4, WDP = 0x27, WDIE = 1 << 6, WDIF = 1 << 7, WDRF = 1 << 3, WINDOW_CYCLES = 4 };

static uint64_t unlocked_until;

static uint64_t
period_cycles(void)
{
    uint8_t value = chip->data[REG_WDTCSR];
    uint32_t step = (uint32_t)((value & 7) | (value >> 2 & 8));
    return (2048ull << step) * (CLOCK_HZ / 128000);
}

static avr_cycle_count_t
bite(avr_t *avr, avr_cycle_count_t when, void *param)
{
    (void)avr;
    (void)when;
    (void)param;
    chip_watchdog_reset();
    return 0;
}

void
watchdog_fed(void)
{
    if (chip->data[REG_WDTCSR] & WDE)
        after(period_cycles(), bite);
}

static void
write_wdtcsr(uint16_t address, uint8_t value)
{
    uint8_t old = chip->data[address];
    int unlocked = chip->cycle <= unlocked_until;
    unlocked_until = 0;
    if (value & (WDIE | WDIF)) {
        chip_fault("WDTCSR 0x%02x: the model has no watchdog interrupt", value);
    } else if ((value & (WDCE | WDE)) == (WDCE | WDE)) {
        unlocked_until = chip->cycle + WINDOW_CYCLES;
        value = old | WDE;
    } else if (!unlocked && (value & (WDE | WDP)) != (old & (WDE | WDP))) {
        chip_fault("the watchdog's time is changed without opening it first (WDTCSR 0x%02x to 0x%02x)", old, value);
    } else if (!(value & WDE) && chip->data[REG_MCUSR] & WDRF) {
        chip_fault("the watchdog is switched off while WDRF is set, which keeps it on");
    }
    chip->data[address] = value & (WDE | WDP);
    if (value & WDE)
        watchdog_fed();
    else
        avr_cycle_timer_cancel(chip, bite, NULL);
}

void
watchdog_init(void)
{
    on_write(REG_WDTCSR, write_wdtcsr);
}

void
watchdog_reset(int by_watchdog)
{
    unlocked_until = 0;
    chip->data[REG_WDTCSR] = by_watchdog ? WDE : 0; /* on, at its shortest time */
    watchdog_fed();
}
