/* Stops a homing move when the filtered signal of a sensor passes a threshold.
 *
 *     sample ─► raw within raw_min..raw_max? ─► filter ─► type: passes trigger_value? ─► trsync, trigger_reason
 *                    │ no                          │ overflow          │ no
 *                    └─────────────────────────────┴──► trsync, error_reason + code    wait for the next sample
 *
 *     abs_ge         |value| >= trigger_value
 *     gt             value > trigger_value
 *     diff_peak_gt   value has fallen by more than trigger_value from its highest
 *
 * A sensor that falls silent for monitor_max times monitor_ticks is an error, too: the head would run on.
 */
#ifndef TRIGGER_ANALOG_H
#define TRIGGER_ANALOG_H

#include <stdint.h>

struct trigger_analog;

struct trigger_analog *trigger_analog_lookup(uint8_t oid);
/* Task context. The sample was taken about now; NULL: nobody listens. */
void trigger_analog_take(struct trigger_analog *t, int32_t sample);
/* The sensor has no sample but a failure, 0 to 3. */
void trigger_analog_fail(struct trigger_analog *t, uint8_t code);

#endif
