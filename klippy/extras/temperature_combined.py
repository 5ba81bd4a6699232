"""Sensor type temperature_combined: several sensors as one (`max`, `min` or `mean` of them).

    sensor_list: temperature_sensor a, extruder     combination_method: mean     maximum_deviation: 5

Once ready, the sensors are read every REPORT_TIME_S from their status. If they differ by more than maximum_deviation
the printer shuts down: one of them is wrong, and nobody knows which.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

REPORT_TIME_S = 0.300
# A heater's reading lags behind by its smoothing and is 0 before the first report: deviations count only from here.
SETTLE_S = 5.0


def mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


METHODS: dict[str, Callable[[Sequence[float]], float]] = {"max": max, "min": min, "mean": mean}


@dataclass(frozen=True, slots=True)
class Combination:
    """Options of the sensor."""

    sensor_names: tuple[str, ...]
    combine: Callable[[Sequence[float]], float]
    max_deviation_c: float


class CombinedTemperature:
    """The object `temperature_combined NAME`."""

    def __init__(self, printer: Printer, name: str, settings: Combination) -> None:
        self.printer = printer
        self.reactor = printer.get_reactor()
        self.name = name
        self.settings = settings
        self.temp_c = 0.0
        self._sensors: list[Any] = []
        self._range_c = (float("-inf"), float("inf"))
        self._callback: Callable[[float, float], None] | None = None
        self._started_s = 0.0
        self._timer = self.reactor.register_timer(self._sample)

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._handle_connect)
        self.printer.register_event_handler("klippy:ready", self._handle_ready)

    def setup_minmax(self, min_temp: float, max_temp: float) -> None:
        self._range_c = (min_temp, max_temp)

    def setup_callback(self, temperature_callback: Callable[[float, float], None]) -> None:
        self._callback = temperature_callback

    def get_report_time_delta(self) -> float:
        return REPORT_TIME_S

    def _handle_connect(self) -> None:
        for name in self.settings.sensor_names:
            sensor = self.printer.lookup_object(name, None)
            report = getattr(sensor, "get_status", None)
            if report is None or "temperature" not in report(self.reactor.monotonic()):
                raise self.printer.config_error(
                    f"temperature_combined '{self.name}': '{name}' in sensor_list is no section with a temperature."
                )
            self._sensors.append(sensor)

    def _handle_ready(self) -> None:
        if self.printer.get_start_args().get("debugoutput") is None:
            self._started_s = self.reactor.monotonic()
            self.reactor.update_timer(self._timer, self.reactor.NOW)

    def _sample(self, eventtime: float) -> float:
        temps_c = [sensor.get_status(eventtime)["temperature"] for sensor in self._sensors]
        settled = eventtime >= self._started_s + SETTLE_S
        problem = self._problem(temps_c) if settled else ""
        if problem:
            self.printer.invoke_shutdown(problem)
            return float(self.reactor.NEVER)
        if not all(temps_c) and not settled:
            return eventtime + REPORT_TIME_S  # the first reports are still to come
        self.temp_c = self.settings.combine(temps_c)
        mcu = self.printer.lookup_object("mcu")
        if self._callback is not None:
            self._callback(mcu.estimated_print_time(eventtime), self.temp_c)
        return eventtime + REPORT_TIME_S

    def _problem(self, temps_c: Sequence[float]) -> str:
        spread_c = max(temps_c) - min(temps_c)
        if spread_c > self.settings.max_deviation_c:
            readings = ", ".join(
                f"{name} {temp_c:.1f}"
                for name, temp_c in zip(self.settings.sensor_names, temps_c, strict=True)
            )
            return (
                f"Combined sensor '{self.name}': its sensors differ by {spread_c:.1f} degrees, more than the maximum"
                f" deviation of {self.settings.max_deviation_c:.1f} ({readings}). One of them must be faulty."
            )
        low_c, high_c = self._range_c
        temp_c = self.settings.combine(temps_c)
        if not low_c <= temp_c <= high_c:
            return f"Combined sensor '{self.name}': {temp_c:.1f} is outside the range {low_c:.1f} to {high_c:.1f}"
        return ""

    def get_status(self, eventtime: float) -> dict[str, float]:
        return {"temperature": round(self.temp_c, 2)}


def build_sensor(config: ConfigWrapper) -> CombinedTemperature:
    """Sensor of a section with this type."""
    printer = config.get_printer()
    settings = Combination(
        config.getlist("sensor_list"),
        config.getchoice("combination_method", METHODS),
        config.getfloat("maximum_deviation", above=0.0),
    )
    if not settings.sensor_names:
        raise config.error(f"Option 'sensor_list' in section '{config.get_name()}' names no sensor.")
    if config.get_name() in settings.sensor_names:
        raise config.error(f"Option 'sensor_list' in section '{config.get_name()}' names the section itself.")
    name = config.get_name().split()[-1]
    sensor = CombinedTemperature(printer, name, settings)
    sensor.register()
    printer.add_object(f"temperature_combined {name}", sensor)
    return sensor


def register_builtin(heaters: Any) -> None:
    """Register the type of this file."""
    heaters.add_sensor_factory("temperature_combined", build_sensor)


def load_config(config: ConfigWrapper) -> None:
    """Section [temperature_combined] of older configs: the type is built in."""
