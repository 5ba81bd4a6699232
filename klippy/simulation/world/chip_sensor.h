/* The temperature sensor in a simulated chip: what its 12-bit ADC makes of it.
 *
 * A specimen within the STM32F334's tolerances (DS9994: 1.34 to 1.52 V at 25 degC, falling by 4.0 to 4.6 mV a kelvin) and away from
 * its typical values, so that a host that takes those for the chip's own is off by 8 K.  5.2 codes a kelvin.
 */
#ifndef FERRITE_CHIP_SENSOR_H
#define FERRITE_CHIP_SENSOR_H

#include <math.h>
#include <stdint.h>

static const double CHIP_SENSOR_25_V = 1.395, CHIP_SENSOR_V_PER_K = -0.0042, CHIP_SENSOR_SUPPLY_V = 3.3;

static inline uint16_t chip_sensor_code(double temp_c)
{
    double code = (CHIP_SENSOR_25_V + CHIP_SENSOR_V_PER_K * (temp_c - 25.0)) / CHIP_SENSOR_SUPPLY_V * 4095.0;
    return (uint16_t)lround(fmin(fmax(code, 0.0), 4095.0));
}

#endif
