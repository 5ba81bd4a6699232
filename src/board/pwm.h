/* Board contract: hardware pulse width modulation.
 *
 *   pwm_setup   task context; cycle_ticks is the wanted period in timer ticks, the port takes the nearest it can (1: the
 *               fastest); value 0..PWM_MAX (exported constant) is in force at once.  Shuts down with
 *               SHUTDOWN_NOT_PWM_PIN on a pin without the hardware.
 *   pwm_write   any context; 0 is off and PWM_MAX is on without pulses; nothing on a struct of zeros (see gpio.h)
 */
#ifndef BOARD_PWM_H
#define BOARD_PWM_H

#include <stdint.h>

#include "port_types.h"

struct pwm_out pwm_setup(uint32_t pin, uint32_t cycle_ticks, uint32_t value);
void pwm_write(struct pwm_out p, uint32_t value);

#endif
