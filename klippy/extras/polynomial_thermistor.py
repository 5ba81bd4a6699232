"""[polynomial_thermistor NAME]: temperature as a polynomial of the ADC pin's voltage (Liu, Chen, Chen 2019, eq 2).

    coefficients: -19.3535, 114.7015, -79.9385     highest power first: T = a2 u^2 + a1 u + a0, T in degC, u in V
    adc_voltage: 5.0                               reference of the ADC
    min_voltage, max_voltage                       where the polynomial was fitted; default 0 and adc_voltage

A polynomial is only worth what it was fitted to: the published one peaks at 90 degC, and a hotter thermistor would read
colder again, which with a heater ends in a fire. So within [min_voltage, max_voltage] it must go one way only (else
the section is refused), outside it is prolonged by a straight line, and a heater whose max_temp lies beyond the fit is
refused: the MCU stops the printer at max_temp.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

from .adc_temperature import PrinterADCtoTemperature, build_sensor

CHECK_STEPS = (
    1000  # of the range, to see that the polynomial is monotonic; a curve of low degree has no narrower bumps
)
BISECTIONS = 50
BEYOND_C = 1e4  # a [temperature_sensor] without a max_temp


class Polynomial:
    """ADC ratio to degC and back."""

    def __init__(self, coefficients: Sequence[float], adc_v: float, low_v: float, high_v: float) -> None:
        """`coefficients` highest power first. Raises ValueError if not monotonic between the two voltages."""
        if len(coefficients) < 2:
            raise ValueError("at least two coefficients are needed")
        if not low_v < high_v:
            raise ValueError("min_voltage must be below max_voltage")
        self._coefficients = tuple(coefficients)
        self._adc_v = adc_v
        self._low_v, self._high_v = low_v, high_v
        slopes = [self._slope(low_v + (high_v - low_v) * i / CHECK_STEPS) for i in range(CHECK_STEPS + 1)]
        self.falling = slopes[0] < 0.0
        if not (all(s < 0.0 for s in slopes) or all(s > 0.0 for s in slopes)):
            turn = next(i for i, s in enumerate(slopes) if (s < 0.0) != self.falling or s == 0.0)
            turn_v = low_v + (high_v - low_v) * turn / CHECK_STEPS
            raise ValueError(
                f"the polynomial turns round at {turn_v:.3f} V ({self._value(turn_v):.1f} degrees): a hotter sensor"
                f" would read colder. Set min_voltage and max_voltage to the range it was fitted to"
            )

    def _value(self, volt: float) -> float:
        result = 0.0
        for coefficient in self._coefficients:
            result = result * volt + coefficient
        return result

    def _slope(self, volt: float) -> float:
        degree = len(self._coefficients) - 1
        result = 0.0
        for i, coefficient in enumerate(self._coefficients[:-1]):
            result = result * volt + coefficient * (degree - i)
        return result

    @property
    def range_c(self) -> tuple[float, float]:
        """Temperatures between which the polynomial holds."""
        low, high = sorted((self._value(self._low_v), self._value(self._high_v)))
        return low, high

    def calc_temp(self, adc: float) -> float:
        volt = adc * self._adc_v
        inside_v = min(self._high_v, max(self._low_v, volt))
        return self._value(inside_v) + (volt - inside_v) * self._slope(inside_v)

    def calc_adc(self, temp: float) -> float:
        low_c, high_c = self.range_c
        cold_v, hot_v = (self._high_v, self._low_v) if self.falling else (self._low_v, self._high_v)
        if temp <= low_c:
            return (cold_v + (temp - low_c) / self._slope(cold_v)) / self._adc_v
        if temp >= high_c:
            return (hot_v + (temp - high_c) / self._slope(hot_v)) / self._adc_v
        for _ in range(BISECTIONS):
            middle_v = 0.5 * (cold_v + hot_v)
            if self._value(middle_v) < temp:
                cold_v = middle_v
            else:
                hot_v = middle_v
        return 0.5 * (cold_v + hot_v) / self._adc_v


class PolynomialSensor(PrinterADCtoTemperature):
    """A sensor whose heater may not go beyond the polynomial's range."""

    def __init__(self, printer: Printer, name: str, pin: str, polynomial: Polynomial) -> None:
        super().__init__(printer, name, pin, polynomial)
        self._hottest_c = polynomial.range_c[1]

    def setup_minmax(self, min_temp: float, max_temp: float) -> None:
        if max_temp > self._hottest_c:
            has = "none" if max_temp > BEYOND_C else f"{max_temp:.1f}"
            raise self.printer.config_error(
                f"Section '{self.name}' needs a max_temp of {self._hottest_c:.1f} at most, it has {has}: its polynomial"
                " thermistor is valid up to there only."
            )
        super().setup_minmax(min_temp, max_temp)


def read_polynomial(config: ConfigWrapper) -> Polynomial:
    """The curve of a section; raises the config's error."""
    adc_v = config.getfloat("adc_voltage", 5.0, above=0.0)
    coefficients = config.getfloatlist("coefficients")
    low_v = config.getfloat("min_voltage", 0.0, minval=0.0, below=adc_v)
    high_v = config.getfloat("max_voltage", adc_v, above=0.0, maxval=adc_v)
    try:
        return Polynomial(coefficients, adc_v, low_v, high_v)
    except ValueError as e:
        raise config.error(f"Section '{config.get_name()}': {e}.") from None


def load_config_prefix(config: ConfigWrapper) -> None:
    """Its name becomes a sensor_type."""
    printer = config.get_printer()
    polynomial = read_polynomial(config)
    name = " ".join(config.get_name().split()[1:])

    def build(sensor_config: Any) -> PolynomialSensor:
        return build_sensor(sensor_config, PolynomialSensor, polynomial)

    printer.load_object(config, "heaters").add_sensor_factory(name, build)
