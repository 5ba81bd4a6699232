"""A temperature sensor whose reading is smoothed, for corrections that follow it."""

from __future__ import annotations

from configfile import ConfigWrapper

from ..temperature_sensor import ABSOLUTE_ZERO_C, PrinterSensorGeneric


class SmoothedSensor(PrinterSensorGeneric):
    """Options sensor_type (and its own), min_temp, max_temp and smooth_time of a section."""

    def __init__(self, config: ConfigWrapper) -> None:
        self._smooth_time_s = config.getfloat("smooth_time", 2.0, above=0.0)
        self._last_time: float | None = None
        self.temp_c = 0.0
        sensor = config.get_printer().load_object(config, "heaters").setup_sensor(config)
        low = config.getfloat("min_temp", ABSOLUTE_ZERO_C, minval=ABSOLUTE_ZERO_C)
        high = config.getfloat("max_temp", 99999999.9, above=low)
        super().__init__(config.get_name().split()[-1], sensor, low, high)

    def _on_reading(self, read_time: float, temp_c: float) -> None:
        super()._on_reading(read_time, temp_c)
        if self._last_time is None:
            self.temp_c = temp_c
        else:
            share = min(1.0, (read_time - self._last_time) / self._smooth_time_s)
            self.temp_c += share * (temp_c - self.temp_c)
        self._last_time = read_time

    def get_temp(self, eventtime: float) -> tuple[float, float]:
        return self.temp_c, 0.0

    def get_status(self, eventtime: float) -> dict[str, float]:
        return {**super().get_status(eventtime), "temperature": round(self.temp_c, 2)}
