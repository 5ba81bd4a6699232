"""Sensor type DS18B20: a 1-wire sensor at the computer, read by Klipper's firmware for Linux (a [mcu] of its own).

The firmware reads the kernel's file for the serial number, in 1/1000 degC, and checks the limits.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper

MAX_ERROR_COUNT = 4


class Ds18b20:
    """One sensor."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name()
        self._serial_no = config.get("serial_no").strip()
        if not self._serial_no.isascii():
            raise config.error(
                f"Option 'serial_no' in section '{self.name}' is a name in /sys/bus/w1/devices such as 28-031674b175ff"
                f" ({config.where('serial_no')})."
            )
        self._report_time_s = config.getfloat("ds18_report_time", 3.0, minval=1.0)
        board = config.get("sensor_mcu")
        mcu = self.printer.lookup_object("mcu" if board == "mcu" else f"mcu {board}", None)
        if mcu is None:
            raise config.error(
                f"Option 'sensor_mcu' in section '{self.name}': there is no [mcu {board}]"
                f" ({config.where('sensor_mcu')})."
            )
        self.mcu = mcu
        self.oid = mcu.create_oid()
        self._range = (0, 0)
        self._callback: Callable[[float, float], None] | None = None
        self._report_ticks = 0
        mcu.register_response(self._on_result, "ds18b20_result", self.oid)
        mcu.register_config_callback(self._build_config)

    def setup_minmax(self, min_temp: float, max_temp: float) -> None:
        """Range for the firmware's check."""
        self._range = (int(min_temp * 1000.0), int(max_temp * 1000.0))

    def setup_callback(self, temperature_callback: Callable[[float, float], None]) -> None:
        self._callback = temperature_callback

    def get_report_time_delta(self) -> float:
        return float(self._report_time_s)

    def _build_config(self) -> None:
        mcu, oid = self.mcu, self.oid
        serial = self._serial_no.encode().hex()
        mcu.add_config_cmd(f"config_ds18b20 oid={oid} serial={serial} max_error_count={MAX_ERROR_COUNT}")
        self._report_ticks = mcu.seconds_to_clock(self._report_time_s)
        low, high = self._range
        mcu.add_config_cmd(
            f"query_ds18b20 oid={oid} clock={mcu.get_query_slot(oid)} rest_ticks={self._report_ticks}"
            f" min_value={low} max_value={high}",
            is_init=True,
        )

    def _on_result(self, params: dict[str, Any]) -> None:
        if params["fault"]:
            logging.warning("DS18B20 %s in section '%s' could not be read", self._serial_no, self.name)
            return
        clock = self.mcu.clock32_to_clock64(params["next_clock"]) - self._report_ticks
        if self._callback is not None:
            self._callback(self.mcu.clock_to_print_time(clock), params["value"] / 1000.0)


def register_builtin(heaters: Any) -> None:
    """Add the type of this file."""
    heaters.add_sensor_factory("DS18B20", Ds18b20)
