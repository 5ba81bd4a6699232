"""[tsl1401cl_filament_width_sensor]: a line sensor whose output has as many volts as the filament has millimetres."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper

from .filament_width.compensation import WidthCompensation, setup_adc

INTERVAL_MM = 10.0


class LineWidthSensor:
    """The object `tsl1401cl_filament_width_sensor`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self._diameter_mm = 0.0
        self._mm_at_full_scale = config.getfloat("adc_voltage", 5.0, above=0.0)
        setup_adc(config, "pin", self._take)
        self.width = WidthCompensation(config, lambda: self._diameter_mm, INTERVAL_MM, True, True)

    def _take(self, print_time: float, value: float) -> None:
        self._diameter_mm = value * self._mm_at_full_scale

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {"Diameter": round(self._diameter_mm, 4), "is_active": self.width.enabled}


def load_config(config: ConfigWrapper) -> LineWidthSensor:
    return LineWidthSensor(config)
