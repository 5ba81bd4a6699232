/* Board contract: slow analog inputs (thermistors).  The 120 kHz sampling of the coil is sync_adc.h.
 *
 * One converter, shared.  A conversion is started and polled, never waited for:
 *
 *   adc_setup   task context; shuts down with SHUTDOWN_NOT_ADC_PIN
 *   adc_poll    timer or task context: start the conversion if the converter is free.  Returns 0 when a result for
 *               THIS input is ready, else in how many ticks to ask again (also when another input has the converter)
 *   adc_take    the result, 0..ADC_MAX (exported constant); only after adc_poll() returned 0; frees the converter
 *   adc_cancel  any context: forget a conversion under way for this input, if any
 */
#ifndef BOARD_ADC_H
#define BOARD_ADC_H

#include <stdint.h>

#include "port_types.h"

struct adc_in adc_setup(uint32_t pin);
uint32_t adc_poll(struct adc_in a);
uint16_t adc_take(struct adc_in a);
void adc_cancel(struct adc_in a);

#endif
