"""Pins of sections that this program has no module for (configabsent.py): they can be named, and do nothing."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import configabsent


class AbsentPin:
    """Stands for an output, an input or an endstop of a section that is left out."""

    def __init__(self, printer: Any, section: str) -> None:
        self._printer = printer
        self._section = section
        self._steppers: list[Any] = []

    def get_mcu(self) -> Any:
        """Times are those of the first board."""
        return self._printer.lookup_object("mcu")

    # -- outputs and inputs --

    def setup_max_duration(self, max_duration: float) -> None:
        """Nothing to limit."""

    def setup_start_value(self, start_value: float, shutdown_value: float) -> None:
        """There is no output."""

    def setup_cycle_time(self, cycle_time: float, hardware_pwm: bool = False) -> None:
        """There is no output."""

    def set_digital(self, print_time: float, value: int) -> None:
        """There is no output."""

    def set_pwm(self, print_time: float, value: float) -> None:
        """There is no output."""

    # -- an endstop --

    def add_stepper(self, stepper: Any) -> None:
        self._steppers.append(stepper)

    def get_steppers(self) -> list[Any]:
        return list(self._steppers)

    def get_position_endstop(self) -> float:
        """Nothing homes here, so any height does."""
        return 0.0

    def home_start(self, *args: Any, **options: Any) -> Any:
        """There is no such switch."""
        raise self._printer.command_error(
            f"There is no endstop to home to: Ferrite does not have [{self._section}] yet"
        )

    def query_endstop(self, print_time: float) -> int:
        """Open."""
        return 0


class AbsentChip:
    """A chip with pins of any name."""

    def __init__(self, printer: Any, section: str) -> None:
        self._printer = printer
        self._section = section

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> AbsentPin:
        """A pin that does nothing. Raises config_error for an analog input: a heater would never get a reading."""
        if pin_type == "adc":
            raise self._printer.config_error(
                f"Pin '{pin_params['chip_name']}:{pin_params['pin']}' can not be read: "
                f"Ferrite does not have [{self._section}] yet"
            )
        return AbsentPin(self._printer, self._section)


def register(printer: Any, left_out: Iterable[str]) -> None:
    """Make the chips of sections that are left out known."""
    pins = printer.lookup_object("pins")
    for chip, section in configabsent.pin_chips(left_out):
        if chip not in pins.chips:
            pins.register_chip(chip, AbsentChip(printer, section))
