"""[adc_temperature NAME] and the plumbing all ADC temperature sensors share.

A sensor is an ADC pin and a curve. The curve turns the pin's ratio (0..1 of the ADC reference) into degC and
back: `Thermistor` in thermistor.py is one, `LinearVoltage` and `LinearResistance` here are tables joined by
straight lines. Readings outside the range of min_temp..max_temp shut the printer down; the MCU checks that
with the host dead.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from configfile import ConfigWrapper
from roles import Printer

from . import query_adc

SAMPLE_TIME_S = 0.001
SAMPLE_COUNT = 8
REPORT_TIME_S = 0.300
END = 0.002  # share of the ADC's scale at either end that means no sensor: 2.3 Mohm and 10 ohm at a pull-up of 4.7 kohm
RANGE_CHECK_COUNT = 4  # consecutive reports out of range before the MCU shuts down


class Curve(Protocol):
    """ADC ratio to temperature and back."""

    def calc_temp(self, adc: float) -> float: ...
    def calc_adc(self, temp: float) -> float: ...


@dataclass(frozen=True, slots=True)
class ReadingRange:
    """What a section allows, in degC, and as ratios of the ADC's full scale."""

    low_c: float = -math.inf
    high_c: float = math.inf
    low: float = 0.0
    high: float = 1.0

    def explain(self, name: str, mcu_adc: Any, curve: Curve, mcu: Any, reason: str) -> str:
        """After a board's "ADC out of range": the text about this sensor, "" if another sensor caused it."""
        value, at_s = mcu_adc.get_last_value()
        if "ADC out of range" not in reason or mcu is not mcu_adc.get_mcu() or not at_s:
            return ""
        scale = mcu_adc.get_full_scale()
        if math.floor(self.low * scale) <= round(value * scale) <= math.ceil(self.high * scale):
            return ""
        reading = (
            f"{curve.calc_temp(value):.1f} C"
            if END < value < 1.0 - END
            else "no temperature, a broken or shorted sensor"
        )
        return f"{name}: {reading}; allowed are {self.low_c:g} to {self.high_c:g} C."


class PrinterADCtoTemperature:
    """One ADC pin with its curve."""

    def __init__(self, printer: Printer, name: str, pin: str, curve: Curve) -> None:
        self.printer = printer
        self.name = name
        self.curve = curve
        self._range = ReadingRange()
        self._callback: Callable[[float, float], None] | None = None
        self.mcu_adc = printer.lookup_object("pins").setup_pin("adc", pin)
        self.mcu_adc.setup_adc_callback(REPORT_TIME_S, self._on_adc)
        printer.register_event_handler("mcu:explain_shutdown", self._explain)

    def setup_callback(self, temperature_callback: Callable[[float, float], None]) -> None:
        """`temperature_callback(print time of the sample, degC)` for every report."""
        self._callback = temperature_callback

    def get_report_time_delta(self) -> float:
        return REPORT_TIME_S

    def setup_minmax(self, min_temp: float, max_temp: float) -> None:
        """Range for the MCU's check."""
        ratios = sorted(min(1.0, max(0.0, self.curve.calc_adc(t))) for t in (min_temp, max_temp))
        self._range = ReadingRange(min_temp, max_temp, ratios[0], ratios[1])
        self.mcu_adc.setup_adc_sample(
            SAMPLE_TIME_S,
            SAMPLE_COUNT,
            minval=ratios[0],
            maxval=ratios[1],
            range_check_count=RANGE_CHECK_COUNT,
        )

    def _explain(self, mcu: Any, reason: str) -> str:
        return self._range.explain(self.name, self.mcu_adc, self.curve, mcu, reason)

    def _on_adc(self, read_time: float, read_value: float) -> None:
        if self._callback is not None:
            self._callback(read_time + SAMPLE_COUNT * SAMPLE_TIME_S, self.curve.calc_temp(read_value))


Sensor = TypeVar("Sensor", bound=PrinterADCtoTemperature)


def build_sensor(config: ConfigWrapper, kind: Callable[[Any, str, str, Any], Sensor], curve: Any) -> Sensor:
    """Sensor on the section's sensor_pin; QUERY_ADC knows it by its section."""
    sensor = kind(config.get_printer(), config.get_name(), config.get("sensor_pin"), curve)
    query_adc.register_adc(config, config.get_name(), sensor.mcu_adc)
    return sensor


class Polyline:
    """Straight lines through points of ascending x, the end pieces prolonged."""

    def __init__(self, points: Sequence[tuple[float, float]]) -> None:
        ordered = sorted(points)
        if len(ordered) < 2:
            raise ValueError("at least two points are needed")
        self._x = [x for x, _ in ordered]
        self._y = [y for _, y in ordered]
        if any(b <= a for a, b in itertools.pairwise(self._x)):
            raise ValueError("two points share the same value")

    def at(self, x: float) -> float:
        """y at x."""
        i = min(max(bisect.bisect_right(self._x, x), 1), len(self._x) - 1)
        x0, x1, y0, y1 = self._x[i - 1], self._x[i], self._y[i - 1], self._y[i]
        return y0 + (x - x0) * (y1 - y0) / (x1 - x0)


def _two_way(temps: Sequence[float], values: Sequence[float]) -> tuple[Polyline, Polyline]:
    """value -> temperature and temperature -> value; raises ValueError if the table is not monotonic."""
    by_temp = Polyline(list(zip(temps, values, strict=True)))
    ordered = [by_temp.at(t) for t in sorted(temps)]
    steps = [b - a for a, b in itertools.pairwise(ordered)]
    if not (all(s > 0 for s in steps) or all(s < 0 for s in steps)):
        raise ValueError("the values neither all rise nor all fall with temperature")
    return Polyline(list(zip(values, temps, strict=True))), by_temp


class LinearVoltage:
    """Amplified sensor: table of (degC, volt), ADC reference `adc_voltage`, offset of the circuit."""

    def __init__(
        self, points: Sequence[tuple[float, float]], adc_voltage: float, voltage_offset: float
    ) -> None:
        temps = [t for t, _ in points]
        ratios = [(volt - voltage_offset) / adc_voltage for _, volt in points]
        self._to_temp, self._to_adc = _two_way(temps, ratios)

    def calc_temp(self, adc: float) -> float:
        return self._to_temp.at(adc)

    def calc_adc(self, temp: float) -> float:
        return self._to_adc.at(temp)


class LinearResistance:
    """Resistor against a pull-up: table of (degC, ohm)."""

    def __init__(self, points: Sequence[tuple[float, float]], pullup_ohm: float) -> None:
        temps = [t for t, _ in points]
        self._pullup_ohm = pullup_ohm
        self._to_temp, self._to_ohm = _two_way(temps, [ohm for _, ohm in points])

    def calc_temp(self, adc: float) -> float:
        ratio = min(0.99999, max(0.00001, adc))
        return self._to_temp.at(self._pullup_ohm * ratio / (1.0 - ratio))

    def calc_adc(self, temp: float) -> float:
        ohm = max(0.0, self._to_ohm.at(temp))
        return ohm / (ohm + self._pullup_ohm)


######################################################################
# Built-in tables, computed from the parts' public data
######################################################################


def platinum_ohm(r0_ohm: float, temp_c: float) -> float:
    """Platinum resistor after IEC 60751 (Callendar-Van Dusen)."""
    a, b, c = 3.9083e-3, -5.775e-7, -4.183e-12
    ratio = 1.0 + a * temp_c + b * temp_c * temp_c
    if temp_c < 0.0:
        ratio += c * (temp_c - 100.0) * temp_c**3
    return r0_ohm * ratio


# Thermocouple amplifiers that are linear by design, (volt at 0 degC, volt per K): datasheets of AD595/AD597
# (10 mV/K) and AD8494..AD8497 (5 mV/K). Points 0..600 degC.
_LINEAR_AMPLIFIERS = {
    "AD595": (0.0, 0.010),
    "AD597": (0.0, 0.010),
    "AD8494": (0.0, 0.005),
    "AD8495": (0.0, 0.005),
    "AD8496": (0.0, 0.005),
    "AD8497": (0.0, 0.005),
}


def _amplifier_points(zero_v: float, slope_v_k: float) -> list[tuple[float, float]]:
    return [(temp, zero_v + slope_v_k * temp) for temp in (0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0)]


# E3D's PT100 board (INA826): the sensor is fed from 5 V through 4400 ohm, the voltage over it amplified tenfold (gives
# the maker's table: 1.11 V at 0, 1.52 V at 100, 2.66 V at 400 degC).
_INA826_SUPPLY_V, _INA826_FEED_OHM, _INA826_GAIN = 5.0, 4400.0, 10.0


def _ina826_points() -> list[tuple[float, float]]:
    points = []
    for temp_c in range(0, 1101, 25):
        ohm = platinum_ohm(100.0, float(temp_c))
        volt = _INA826_GAIN * _INA826_SUPPLY_V * ohm / (ohm + _INA826_FEED_OHM)
        points.append((float(temp_c), volt))
    return points


def _pt1000_points() -> list[tuple[float, float]]:
    return [(float(t), platinum_ohm(1000.0, float(t))) for t in range(-50, 551, 25)]


def read_voltage_sensor(
    config: ConfigWrapper, points: Sequence[tuple[float, float]], table_section: Any
) -> PrinterADCtoTemperature:
    """Sensor of an amplifier.

    `config` has the pin and the reference, `table_section` gets the blame for a bad table.
    """
    adc_voltage = config.getfloat("adc_voltage", 5.0, above=0.0)
    voltage_offset = config.getfloat("voltage_offset", 0.0)
    try:
        curve = LinearVoltage(points, adc_voltage, voltage_offset)
    except ValueError as e:
        raise table_section.error(
            f"adc_temperature table in section '{table_section.get_name()}': {e}"
        ) from None
    return _sensor(config, curve)


def read_resistance_sensor(
    config: ConfigWrapper, points: Sequence[tuple[float, float]], table_section: Any
) -> PrinterADCtoTemperature:
    """Sensor of a resistor with pull-up."""
    pullup_ohm = config.getfloat("pullup_resistor", 4700.0, above=0.0)
    try:
        curve = LinearResistance(points, pullup_ohm)
    except ValueError as e:
        raise table_section.error(
            f"adc_temperature table in section '{table_section.get_name()}': {e}"
        ) from None
    return _sensor(config, curve)


def _sensor(config: ConfigWrapper, curve: Curve) -> PrinterADCtoTemperature:
    return build_sensor(config, PrinterADCtoTemperature, curve)


def register_builtin(heaters: Any) -> None:
    """Register the types built in here."""
    for name, (zero_v, slope_v_k) in _LINEAR_AMPLIFIERS.items():
        points = _amplifier_points(zero_v, slope_v_k)
        heaters.add_sensor_factory(name, lambda c, p=points: read_voltage_sensor(c, p, c))
    heaters.add_sensor_factory("PT100 INA826", lambda c: read_voltage_sensor(c, _ina826_points(), c))
    heaters.add_sensor_factory("PT1000", lambda c: read_resistance_sensor(c, _pt1000_points(), c))


def _read_table(config: ConfigWrapper, value_option: str) -> list[tuple[float, float]]:
    """temperature1/VALUE1, temperature2/VALUE2 ... as far as they go; at least two."""
    points = []
    index = 1
    while index <= 2 or config.get(f"temperature{index}", None) is not None:
        temp = config.getfloat(f"temperature{index}")
        points.append((temp, config.getfloat(f"{value_option}{index}")))
        index += 1
    return points


def load_config_prefix(config: ConfigWrapper) -> None:
    """A custom table: its name becomes a sensor_type."""
    heaters = config.get_printer().load_object(config, "heaters")
    name = " ".join(config.get_name().split()[1:])
    if config.get("resistance1", None) is None:
        points = _read_table(config, "voltage")
        heaters.add_sensor_factory(name, lambda c: read_voltage_sensor(c, points, config))
    else:
        points = _read_table(config, "resistance")
        if min(ohm for _, ohm in points) <= 0.0 or not all(math.isfinite(ohm) for _, ohm in points):
            raise config.error(f"Resistances must be above 0 in section '{config.get_name()}'")
        heaters.add_sensor_factory(name, lambda c: read_resistance_sensor(c, points, config))
