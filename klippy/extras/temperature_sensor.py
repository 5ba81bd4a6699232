"""[temperature_sensor NAME]: a sensor that only reports."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper

ABSOLUTE_ZERO_C = -273.15


class PrinterSensorGeneric:
    """Newest, lowest and highest reading of one sensor."""

    def __init__(self, name: str, sensor: Any, min_temp_c: float, max_temp_c: float) -> None:
        self.name = name
        self.sensor = sensor
        self.last_temp = 0.0
        self._seen: tuple[float, float] | None = None
        sensor.setup_minmax(min_temp_c, max_temp_c)
        sensor.setup_callback(self._on_reading)

    def _on_reading(self, read_time: float, temp_c: float) -> None:
        self.last_temp = temp_c
        if temp_c:  # a plain 0 is "no reading yet" with some sensors
            low, high = self._seen or (temp_c, temp_c)
            self._seen = min(low, temp_c), max(high, temp_c)

    def get_temp(self, eventtime: float) -> tuple[float, float]:
        return self.last_temp, 0.0

    def stats(self, eventtime: float) -> tuple[bool, str]:
        return False, f"{self.name}: temp={self.last_temp:.1f}"

    def get_status(self, eventtime: float) -> dict[str, float]:
        low, high = self._seen or (0.0, 0.0)
        return {
            "temperature": round(self.last_temp, 2),
            "measured_min_temp": round(low, 2),
            "measured_max_temp": round(high, 2),
        }


def load_config_prefix(config: ConfigWrapper) -> PrinterSensorGeneric:
    heaters = config.get_printer().load_object(config, "heaters")
    sensor = heaters.setup_sensor(config)
    min_temp_c = config.getfloat("min_temp", ABSOLUTE_ZERO_C, minval=ABSOLUTE_ZERO_C)
    max_temp_c = config.getfloat("max_temp", 99999999.9, above=min_temp_c)
    generic = PrinterSensorGeneric(config.get_name().split()[-1], sensor, min_temp_c, max_temp_c)
    heaters.register_sensor(config, generic)
    return generic
