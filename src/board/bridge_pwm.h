/* Board contract: the phase-shifted full bridge that drives the coil.
 *
 *     leg A  ‾‾‾‾\____/‾‾‾‾\____      phase = how far leg B lags leg A, in 0..BRIDGE_PHASE_MAX of half a period:
 *     leg B  ____/‾‾‾‾\____/‾‾‾‾      0 = legs together = no voltage over the coil, BRIDGE_PHASE_MAX = 180 degrees
 *            |<-- period_ticks -->|
 *
 * Fixed frequency; the phase sets the power.  "Period edge" is the instant the period counter restarts: the port updates
 * the phase there (shadow registers), so no half-made pulse ever reaches the switches; dead time is the port's.
 *
 *   bridge_pwm_setup      task context; period in timer ticks (72 MHz / 600 = 120 kHz).  Shuts down with
 *                         SHUTDOWN_BRIDGE_ID or SHUTDOWN_BRIDGE_PERIOD, or, on hardware, with another SHUTDOWN_BRIDGE_
 *                         reason for whatever is not as it was set up.  Starts counting with phase 0, outputs off.
 *   bridge_pwm_set_phase  any context; in force from the first period edge after the call on.  Seen from the
 *                         synchronous ADC: from sample number sync_adc_position() on.  A value above BRIDGE_PHASE_MAX
 *                         is taken as BRIDGE_PHASE_MAX.  Ports switch the outputs off for phase 0.  May shut down: a
 *                         port looks at its hardware again before it switches on.
 *   bridge_pwm_off        any context: outputs off now, in the middle of a period if need be, and a phase not yet in
 *                         force is forgotten.  The next bridge_pwm_set_phase() switches them on again.
 *
 * Hardware faults (a driver's fault line, the supply, the clock) switch the outputs off without the firmware; the port's
 * interrupt then calls try_shutdown() with SHUTDOWN_BRIDGE_FAULT or SHUTDOWN_BRIDGE_SYSTEM_FAULT inside sched_guarded().
 */
#ifndef BOARD_BRIDGE_PWM_H
#define BOARD_BRIDGE_PWM_H

#include <stdint.h>

enum { BRIDGE_PHASE_MAX = 45000 };

struct bridge_pwm {
    uint8_t id;
};

struct bridge_pwm bridge_pwm_setup(uint8_t id, uint32_t period_ticks);
void bridge_pwm_set_phase(struct bridge_pwm b, uint16_t phase);
void bridge_pwm_off(struct bridge_pwm b);

#endif
