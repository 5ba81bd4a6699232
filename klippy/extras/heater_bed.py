"""[heater_bed]: the heated bed, M140 and M190."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer


class PrinterHeaterBed:
    """The bed's heater with its two commands."""

    def __init__(self, printer: Printer, heater: Any) -> None:
        self.printer = printer
        self.heater = heater
        self.get_status = heater.get_status
        self.stats = heater.stats

    def register(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command("M140", self.cmd_M140)
        gcode.register_command("M190", self.cmd_M190)

    def _set(self, gcmd: GCodeCommand, wait: bool) -> None:
        temp_c = gcmd.get_float("S", 0.0)
        self.printer.lookup_object("heaters").set_temperature(self.heater, temp_c, wait)

    def cmd_M140(self, gcmd: GCodeCommand) -> None:
        """Set the bed's target."""
        self._set(gcmd, wait=False)

    def cmd_M190(self, gcmd: GCodeCommand) -> None:
        """Set the bed's target and wait."""
        self._set(gcmd, wait=True)


def load_config(config: ConfigWrapper) -> PrinterHeaterBed:
    printer = config.get_printer()
    heater = printer.load_object(config, "heaters").setup_heater(config, "B")
    bed = PrinterHeaterBed(printer, heater)
    bed.register()
    return bed
