/* One simulated MCU as a shared library.
 *
 * The firmware of src/, complete, on a port whose hardware is this interface.  A library holds one MCU: for several,
 * load several copies of the file.  All clocks are the MCU's own 64-bit tick count (SIM_CLOCK_HZ ticks a second, starting
 * wherever sim_mcu_boot() says); the firmware sees the low 32 bits.  Whoever loads the library owns time: nothing here
 * waits, reads a host clock or draws a random number.
 *
 * Time stands still while firmware code runs.  Order at one clock: bridge edge, then ADC half buffer, then timers, then
 * tasks; so the same calls give the same results, to the bit.
 */
#ifndef SIM_MCU_H
#define SIM_MCU_H

#include <stdint.h>

#define SIM_EXPORT __attribute__((visibility("default")))
#define SIM_PIN_TEMPERATURE 254

#ifdef __cplusplus
extern "C" {
#endif

/* What the world offers one MCU.  Calls come from inside sim_mcu_boot() and sim_mcu_advance() and must not call back into
 * the library.  Their clocks never decrease, except that sync_adc_read()'s samples lie before the present, and that pins
 * which a task toggles by hand (software SPI, LED chains) run ahead of it by what the task has waited. */
struct sim_board {
    void *ctx;
    void (*pin_write)(void *ctx, uint32_t pin, uint8_t value, uint64_t clock);
    uint8_t (*pin_read)(void *ctx, uint32_t pin, uint64_t clock);
    /* value 0..PWM_MAX of cycle_ticks */
    void (*pwm_write)(void *ctx, uint32_t pin, uint32_t cycle_ticks, uint32_t value, uint64_t clock);
    /* 12 bits; SIM_PIN_TEMPERATURE: the chip's own temperature sensor. */
    uint16_t (*adc_read)(void *ctx, uint32_t pin, uint64_t clock);
    /* In force from `clock` on: a period edge, or any clock when the firmware switches off at once. */
    void (*bridge_set)(void *ctx, uint16_t phase, uint64_t clock);
    /* `count` samples at first_clock, first_clock + period_ticks, ...; all lie under the phase last set, and after
     * all samples read before. */
    void (*sync_adc_read)(void *ctx, uint16_t *samples, uint32_t count, uint64_t first_clock, uint32_t period_ticks);
    /* Samples from the next sync_adc_read() on are taken `ticks` later in the period than the machine was tuned for.  May
     * be NULL. */
    void (*sync_adc_move)(void *ctx, uint32_t ticks, uint64_t clock);
    void (*console_send)(void *ctx, const uint8_t *data, uint32_t len, uint64_t clock);
    /* Devices on hardware buses; either may be NULL: nothing is connected.  What comes back takes the place of `data`;
     * pin_write has selected the chip before. */
    void (*spi_exchange)(void *ctx, uint32_t bus, uint8_t mode, uint8_t *data, uint32_t len, uint64_t clock);
    /* Returns an enum i2c_status (src/board/i2c_status.h): 0 done, 3 no device has this address, ... */
    uint8_t (*i2c_exchange)(void *ctx, uint32_t bus, uint8_t address, const uint8_t *write, uint32_t write_len,
                            uint8_t *read, uint32_t read_len, uint64_t clock);
};

/* Power on at `clock` (also after a reset, or in the middle of anything).  *board is copied. */
SIM_EXPORT void sim_mcu_boot(const struct sim_board *board, uint64_t clock);
/* Clock of the next thing to do; UINT64_MAX if none (before boot, after a reset request). */
SIM_EXPORT uint64_t sim_mcu_next_event(void);
/* Run all that is due up to and including `clock`; the MCU's present is then `clock`.  A clock in the past does nothing
 * but run tasks that wait. */
SIM_EXPORT void sim_mcu_advance(uint64_t clock);
/* Bytes arrive now (the clock last advanced to); the firmware looks at them in the next sim_mcu_advance().  Bytes beyond
 * the receive buffer are lost, as on a board. */
SIM_EXPORT void sim_mcu_receive(const uint8_t *data, uint32_t len);
/* 1 once if the firmware has asked for a reset: it is then dead until sim_mcu_boot(). */
SIM_EXPORT int sim_mcu_take_reset(void);

/* The synchronous ADC takes no more samples until the next boot: its trigger is dead. */
SIM_EXPORT void sim_mcu_stop_adc(void);

#ifdef __cplusplus
}
#endif

#endif
