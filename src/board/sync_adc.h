/* Board contract: the fast ADC, one conversion per bridge period at a fixed point of it, moved by DMA.
 *
 *     bridge edge ─► trigger ─► conversion ─► DMA ─► | half 0: half_len samples | half 1: half_len samples | ─┐
 *                                                    ▲                    ready(half 0)        ready(half 1)  │
 *                                                    └────────────────────────────────────────────────────────┘
 *
 *   sync_adc_setup     task context; `ready` will be called in irq context (inside sched_guarded) once per half
 *                      buffer; the samples stay valid until the other half is full, half_len periods later.
 *                      Shuts down with SHUTDOWN_NOT_ADC_PIN or SHUTDOWN_SYNC_ADC.
 *   sync_adc_start     task context: restart; returns the clock of sample 0 (a period edge, in the future);
 *                      sample n is taken at start + n * period_ticks.
 *   sync_adc_position  samples converted since start, running 32 bit; any context.  A sample counts from its own
 *                      clock on.  Half buffer k holds samples k * half_len ...; if position runs more than
 *                      2 * half_len ahead of what `ready` has been given, samples were lost.
 *
 *   sync_adc_move      any context: from the next period edge on samples are taken so many ticks later in the period than
 *                      usual, 0 as usual; seen from sample number sync_adc_position() on.  At most SYNC_ADC_MOVE_TICKS.
 *                      A port that cannot do that defines PORT_SYNC_ADC_FIXED and need not have the function.
 *
 * half_len is the caller's choice, PORT_SYNC_HALF_LEN if the port defines it (they share an interrupt's cost).
 */
#ifndef BOARD_SYNC_ADC_H
#define BOARD_SYNC_ADC_H

#include <stdint.h>

#include "board/bridge_pwm.h"

enum { SYNC_ADC_MOVE_TICKS = 7 }; /* 97 ns at 72 MHz: 4.2 degrees of 120 kHz */

struct sync_adc {
    uint8_t id;
};

typedef void (*sync_adc_ready_fn)(const uint16_t *samples, uint16_t count);

struct sync_adc sync_adc_setup(uint32_t pin, struct bridge_pwm bridge, uint16_t half_len, sync_adc_ready_fn ready);
uint32_t sync_adc_start(struct sync_adc a);
uint32_t sync_adc_position(struct sync_adc a);
void sync_adc_move(struct sync_adc a, uint16_t ticks);

#endif
