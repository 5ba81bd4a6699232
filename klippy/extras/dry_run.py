"""[dry_run]: a print file above the bed, heaters off and extrusion left out.

    DRY_RUN ENABLE=1 [Z_OFFSET=10]      from now on, until ENABLE=0
    DRY_RUN FILENAME=part.gcode [...]   run that file so; it ends by itself

While it lasts, moves keep their X, Y and Z (lifted by Z_OFFSET), filament does not move, and the commands that would
heat are answered and left undone. Homing goes the usual way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

_Z, _E = 2, 3
HEATING = (
    "M104",
    "M109",
    "M140",
    "M190",
    "SET_HEATER_TEMPERATURE",
    "TEMPERATURE_WAIT",
    "SET_SEGMENT_TEMPERATURE",
)
OVER = ("complete", "cancelled", "error", "standby")
POLL_S = 0.5


class LiftedPath:
    """Position transform: Z lifted, filament held. It passes moves on to the transform before it."""

    def __init__(self, following: Any, z_offset_mm: float) -> None:
        self._next = following
        self._z_offset_mm = z_offset_mm
        start = following.get_position()
        self._held_e_mm = start[_E]
        self._commanded_e_mm = start[_E]

    def get_position(self) -> list[float]:
        position = list(self._next.get_position())
        position[_Z] -= self._z_offset_mm
        position[_E] = self._commanded_e_mm
        return position

    def move(self, newpos: Sequence[float], speed: float) -> None:
        self._commanded_e_mm = newpos[_E]
        lifted = [*newpos[:_Z], newpos[_Z] + self._z_offset_mm, self._held_e_mm, *newpos[_E + 1 :]]
        self._next.move(lifted, speed)


class DryRun:
    """The object `dry_run`."""

    def __init__(self, printer: Printer, z_offset_mm: float) -> None:
        self.printer = printer
        self._z_offset_mm = z_offset_mm  # default
        self._reactor = printer.get_reactor()
        self._gcode = printer.lookup_object("gcode")
        self._path: LiftedPath | None = None
        self._before: Any = None
        self._handlers: dict[str, Any] = {}
        self._file = ""
        self._left_out = 0
        self._timer = self._reactor.register_timer(self._on_timer)

    def register(self) -> None:
        self._gcode.register_command("DRY_RUN", self.cmd_DRY_RUN, desc="Run without heat and filament")

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {"enabled": self._path is not None, "file": self._file}

    def cmd_DRY_RUN(self, gcmd: GCodeCommand) -> None:
        name = gcmd.get("FILENAME", "")
        enable = bool(gcmd.get_int("ENABLE", 1 if name else None, minval=0, maxval=1))
        z_offset_mm = gcmd.get_float("Z_OFFSET", self._z_offset_mm, minval=0.0)
        if not enable:
            if self._path is None:
                raise gcmd.error("DRY_RUN: none is under way")
            self._end()
            return
        if self._path is not None:
            raise gcmd.error("DRY_RUN is under way already; DRY_RUN ENABLE=0 ends it")
        if name and self.printer.lookup_object("virtual_sdcard", None) is None:
            raise gcmd.error("DRY_RUN FILENAME needs a [virtual_sdcard]")
        self._begin(z_offset_mm)
        if name:
            self._file = name
            try:
                self._gcode.run_script_from_command(f'SDCARD_PRINT_FILE FILENAME="{name}"')
            except Exception:
                self._end()
                raise
            self._reactor.update_timer(self._timer, self._reactor.monotonic() + POLL_S)

    def _begin(self, z_offset_mm: float) -> None:
        heaters = self.printer.lookup_object("heaters", None)
        if heaters is not None:
            heaters.turn_off_all_heaters()
        gcode_move = self.printer.lookup_object("gcode_move")
        self._before = gcode_move.transform
        self._path = LiftedPath(self._before, z_offset_mm)
        gcode_move.set_move_transform(self._path, force=True)
        gcode_move.reset_last_position()
        self._left_out = 0
        for command in HEATING:
            handler = self._gcode.get_handler(command)
            if handler is not None:
                self._handlers[command] = self._gcode.register_command(command, None)
                self._gcode.register_command(command, self._leave_out)
        self._gcode.respond_info(f"Dry run: {z_offset_mm:g} mm above the path, no heat, no filament")

    def _leave_out(self, gcmd: GCodeCommand) -> None:
        self._left_out += 1

    def _end(self) -> None:
        gcode_move = self.printer.lookup_object("gcode_move")
        for command, handler in self._handlers.items():
            self._gcode.register_command(command, None)
            self._gcode.register_command(command, handler)
        self._handlers = {}
        if gcode_move.transform is self._path:  # else another transform is on top: this one stays, lifted
            gcode_move.set_move_transform(self._before, force=True)
            gcode_move.reset_last_position()
        self._path = None
        self._file = ""
        self._gcode.respond_info(f"Dry run: over, {self._left_out} heating commands left out")

    def _on_timer(self, eventtime: float) -> float:
        """A dry run of a file ends with the file."""
        if self._path is None or not self._file:
            return float(self._reactor.NEVER)
        state = self.printer.lookup_object("print_stats").get_status(eventtime)["state"]
        if state in OVER:
            self._gcode.run_script("DRY_RUN ENABLE=0")
            return float(self._reactor.NEVER)
        return eventtime + POLL_S


def load_config(config: ConfigWrapper) -> DryRun:
    run = DryRun(config.get_printer(), config.getfloat("z_offset", 10.0, minval=0.0))
    run.register()
    return run
