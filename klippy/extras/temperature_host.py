"""Sensor type temperature_host: the temperature of the computer this runs on.

Read from a file (`sensor_path`, default the first thermal zone) in thousandths of a degree, once a second.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

DEFAULT_PATH = "/sys/class/thermal/thermal_zone0/temp"
REPORT_TIME_S = 1.0


def read_millidegrees(path: str) -> float:
    """degC in the file; raises OSError or ValueError."""
    with open(path, encoding="ascii") as handle:
        text = handle.read().strip()
    try:
        return float(text) / 1000.0
    except ValueError:
        raise ValueError(f"there is no number but '{text[:20]}'") from None


class HostTemperature:
    """The object `temperature_host NAME`."""

    def __init__(self, printer: Printer, name: str, path: str) -> None:
        self.printer = printer
        self.reactor = printer.get_reactor()
        self.name = name
        self.path = path
        self.temp_c = 0.0
        self._range_c = (float("-inf"), float("inf"))
        self._callback: Callable[[float, float], None] | None = None
        self._timer = self.reactor.register_timer(self._sample)

    def register(self) -> None:
        """Begin once connected; a file that cannot be read is a config error then."""
        self.printer.register_event_handler("klippy:connect", self._handle_connect)

    def setup_minmax(self, min_temp: float, max_temp: float) -> None:
        self._range_c = (min_temp, max_temp)

    def setup_callback(self, temperature_callback: Callable[[float, float], None]) -> None:
        self._callback = temperature_callback

    def get_report_time_delta(self) -> float:
        return REPORT_TIME_S

    def _handle_connect(self) -> None:
        if self.printer.get_start_args().get("debugoutput") is not None:
            return  # nothing is measured in batch mode
        try:
            read_millidegrees(self.path)
        except (OSError, ValueError) as e:
            raise self.printer.config_error(
                f"temperature_host '{self.name}' cannot read a temperature from {self.path} ({e})."
            ) from None
        self.reactor.update_timer(self._timer, self.reactor.NOW)

    def _sample(self, eventtime: float) -> float:
        try:
            self.temp_c = read_millidegrees(self.path)
        except (OSError, ValueError) as e:
            logging.warning("temperature_host %s: %s", self.name, e)
            return eventtime + REPORT_TIME_S
        low_c, high_c = self._range_c
        if not low_c <= self.temp_c <= high_c:
            self.printer.invoke_shutdown(
                f"HOST temperature {self.temp_c:.1f} outside the range of {low_c:.1f} to {high_c:.1f}"
                f" of sensor '{self.name}'"
            )
            return float(self.reactor.NEVER)
        mcu = self.printer.lookup_object("mcu")
        if self._callback is not None:
            self._callback(mcu.estimated_print_time(eventtime), self.temp_c)
        return eventtime + REPORT_TIME_S

    def get_status(self, eventtime: float) -> dict[str, float]:
        return {"temperature": round(self.temp_c, 2)}


def build_sensor(config: ConfigWrapper) -> HostTemperature:
    """Sensor of a section with this type."""
    printer = config.get_printer()
    name = config.get_name().split()[-1]
    sensor = HostTemperature(printer, name, config.get("sensor_path", DEFAULT_PATH))
    sensor.register()
    printer.add_object(f"temperature_host {name}", sensor)
    return sensor


def register_builtin(heaters: Any) -> None:
    """Register the type of this file."""
    heaters.add_sensor_factory("temperature_host", build_sensor)


def load_config(config: ConfigWrapper) -> None:
    """Section [temperature_host] of older configs: the type is built in."""
