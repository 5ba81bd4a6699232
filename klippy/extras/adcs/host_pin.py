"""An analog pin whose value is computed on the host: the interface of the board's own, with the range checked here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from roles import Printer


class HostAdcPin:
    """`take` is called with each reading."""

    def __init__(self, printer: Printer, name: str, mcu: Any) -> None:
        self.printer = printer
        self.name = name
        self.report_time_s = 0.0
        self._mcu = mcu
        self._range = (0.0, 1.0)
        self._range_check_count = 0
        self._outside = 0
        self._callback: Callable[[float, float], None] | None = None
        self._last = (0.0, 0.0)

    def get_mcu(self) -> Any:
        return self._mcu

    def setup_adc_sample(
        self, sample_time: float, sample_count: int, minval: float = 0.0, maxval: float = 1.0,
        range_check_count: int = 0,
    ) -> None:  # fmt: skip
        """The printer shuts down after `range_check_count` values in a row outside of the range; 0: never."""
        self._range, self._range_check_count = (minval, maxval), range_check_count

    def setup_adc_callback(self, report_time: float, callback: Callable[[float, float], None]) -> None:
        """`callback(print_time, value)` every report_time s, value 0..1."""
        self.report_time_s, self._callback = report_time, callback

    def get_last_value(self) -> tuple[float, float]:
        """(value 0..1, print time) of the last reading."""
        return self._last

    def take(self, read_time: float, value: float) -> None:
        """A reading."""
        self._last = (value, read_time)
        low, high = self._range
        self._outside = 0 if low <= value <= high else self._outside + 1
        if self._range_check_count and self._outside >= self._range_check_count:
            self.printer.invoke_shutdown(
                f"Analog pin {self.name}: {value:.4f} is outside of {low:.4f} to {high:.4f}."
                " Check the sensor on this pin and its wires."
            )
            return
        if self._callback is not None:
            self._callback(read_time, value)
