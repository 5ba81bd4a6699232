"""[extruder_stepper NAME]: a further motor that follows an extruder's motion (or, at first, none)."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from kinematics.extruder import ExtruderStepper
from roles import Printer


class PrinterExtruderStepper:
    """Printer object 'extruder_stepper NAME'."""

    def __init__(self, printer: Printer, motor: ExtruderStepper, extruder_name: str) -> None:
        self.printer = printer
        self.extruder_stepper = motor
        self.extruder_name = extruder_name

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._handle_connect)

    def _handle_connect(self) -> None:
        self.extruder_stepper.sync_to_extruder(self.extruder_name)

    def find_past_position(self, print_time: float) -> float:
        return self.extruder_stepper.find_past_position(print_time)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return self.extruder_stepper.get_status(eventtime)


def load_config_prefix(config: ConfigWrapper) -> PrinterExtruderStepper:
    motor = PrinterExtruderStepper(config.get_printer(), ExtruderStepper(config), config.get("extruder"))
    motor.register()
    return motor
