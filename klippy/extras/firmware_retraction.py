"""[firmware_retraction]: G10 and G11 with the lengths and speeds of the printer instead of the slicer."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from motionlimits import LENGTH, SPEED
from roles import Printer


@dataclass(frozen=True, slots=True)
class Retraction:
    """mm and mm/s."""

    retract_length: float = 0.0
    retract_speed: float = 20.0
    unretract_extra_length: float = 0.0
    unretract_speed: float = 10.0


MIN_SPEED_MM_S = 1.0
STATE = "_firmware_retraction"


def _bounds(name: str) -> dict[str, Any]:
    is_length = name.endswith("_length")
    return {
        "minval": 0.0 if is_length else MIN_SPEED_MM_S,
        "maxval": (LENGTH if is_length else SPEED)["maxval"],
    }


class FirmwareRetraction:
    """Printer object 'firmware_retraction'."""

    def __init__(self, printer: Printer, values: Retraction) -> None:
        self.printer = printer
        self.values = values
        self.is_retracted = False
        self.gcode = printer.lookup_object("gcode")

    def register_commands(self) -> None:
        for name in ("SET_RETRACTION", "GET_RETRACTION"):
            self.gcode.register_command(
                name, getattr(self, f"cmd_{name}"), desc=f"{name[:3].title()} firmware retraction parameters"
            )
        self.gcode.register_command("G10", self.cmd_G10)
        self.gcode.register_command("G11", self.cmd_G11)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {f.name: getattr(self.values, f.name) for f in fields(Retraction)}

    def cmd_SET_RETRACTION(self, gcmd: GCodeCommand) -> None:
        """SET_RETRACTION [RETRACT_LENGTH=] [RETRACT_SPEED=] [UNRETRACT_EXTRA_LENGTH=] [UNRETRACT_SPEED=]."""
        self.values = replace(
            self.values,
            **{
                name: gcmd.get_float(name.upper(), value, **_bounds(name))
                for name, value in self.get_status(0.0).items()
            },
        )
        self.is_retracted = False

    def cmd_GET_RETRACTION(self, gcmd: GCodeCommand) -> None:
        """Report the values."""
        gcmd.respond_info(
            " ".join(f"{name.upper()}={value:.5f}" for name, value in self.get_status(0.0).items())
        )

    def _extrude(self, length: float, speed: float) -> None:
        """Leaves the modes and the G-code position of the other axes as they are."""
        self.gcode.run_script_from_command(
            f"SAVE_GCODE_STATE NAME={STATE}\nG91\nM83\nG1 E{length:.5f} F{speed * 60.0:.3f}\n"
            f"RESTORE_GCODE_STATE NAME={STATE}"
        )

    def cmd_G10(self, gcmd: GCodeCommand) -> None:
        """Retract, once."""
        if not self.is_retracted:
            self._extrude(-self.values.retract_length, self.values.retract_speed)
            self.is_retracted = True

    def cmd_G11(self, gcmd: GCodeCommand) -> None:
        """Undo G10."""
        if self.is_retracted:
            length = self.values.retract_length + self.values.unretract_extra_length
            self._extrude(length, self.values.unretract_speed)
            self.is_retracted = False


def load_config(config: ConfigWrapper) -> FirmwareRetraction:
    values = Retraction(
        **{f.name: config.getfloat(f.name, f.default, **_bounds(f.name)) for f in fields(Retraction)}
    )
    retraction = FirmwareRetraction(config.get_printer(), values)
    retraction.register_commands()
    return retraction
