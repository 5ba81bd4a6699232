"""TUNING_TOWER: sets a parameter by the height of the print, for calibration towers.

value(z) = START + FACTOR * z                       z counted from SKIP, constant within each BAND
value(z) = START + STEP_DELTA * floor(z / STEP_HEIGHT)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from gcode_command import is_traditional
from roles import Printer

_TINY_MM = 1e-8  # a height computed a hair below a step belongs to the step


def band_law(start: float, factor: float, band_mm: float) -> Callable[[float], float]:
    """Value by height; with a band the value of its middle holds for all of it."""

    def law(z_mm: float) -> float:
        if band_mm:
            z_mm = (math.floor(z_mm / band_mm + _TINY_MM) + 0.5) * band_mm
        return start + factor * z_mm

    return law


def step_law(start: float, delta: float, height_mm: float) -> Callable[[float], float]:
    """Value by height, in steps."""
    return lambda z_mm: start + delta * math.floor(z_mm / height_mm + _TINY_MM)


class _Tower:
    """Position transform of one running test: looks at Z of extruding moves, changes none."""

    def __init__(
        self, following: Any, skip_mm: float, law: Callable[[float], float], apply: Callable[[float], None]
    ) -> None:
        self.following = following
        self._skip_mm = skip_mm
        self._law = law
        self._apply = apply
        self._e_mm = following.get_position()[3]
        self._z_mm: float | None = None
        self._value: float | None = None
        self.on_end: Callable[[], None] = lambda: None

    def get_position(self) -> list[float]:
        position = list(self.following.get_position())
        self._e_mm = position[3]
        return position

    def move(self, newpos: Sequence[float], speed: float) -> None:
        extruding = newpos[3] > self._e_mm
        self._e_mm, z_mm = newpos[3], newpos[2]
        if extruding and z_mm != self._z_mm:
            if self._z_mm is not None and z_mm < self._z_mm - _TINY_MM:
                self.on_end()  # printing lower than before: another print
            else:
                self._z_mm = z_mm
                self._update(max(z_mm - self._skip_mm, 0.0))
        self.following.move(newpos, speed)

    def _update(self, z_mm: float) -> None:
        value = self._law(z_mm)
        if value != self._value:
            self._value = value
            self._apply(value)


class TuningTower:
    """The object `tuning_tower`: at most one test at a time."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.gcode = printer.lookup_object("gcode")
        self._tower: _Tower | None = None

    def register(self) -> None:
        """Make command and event known."""
        self.gcode.register_command("TUNING_TOWER", self.cmd_TUNING_TOWER, desc=self.cmd_TUNING_TOWER_help)
        self.printer.register_event_handler("virtual_sdcard:reset_file", self._end)

    cmd_TUNING_TOWER_help = "Tool to adjust a parameter at each Z height"

    def cmd_TUNING_TOWER(self, gcmd: GCodeCommand) -> None:
        """Start a test; a running one ends."""
        self._end()
        command, parameter = gcmd.get("COMMAND"), gcmd.get("PARAMETER")
        start = gcmd.get_float("START", 0.0)
        skip_mm = gcmd.get_float("SKIP", 0.0, minval=0.0)
        factor, band_mm = gcmd.get_float("FACTOR", 0.0), gcmd.get_float("BAND", 0.0, minval=0.0)
        delta, height_mm = gcmd.get_float("STEP_DELTA", 0.0), gcmd.get_float("STEP_HEIGHT", 0.0, minval=0.0)
        if factor and (delta or height_mm):
            raise gcmd.error("TUNING_TOWER: use FACTOR, or STEP_DELTA with STEP_HEIGHT, not both")
        if bool(delta) != bool(height_mm):
            raise gcmd.error("TUNING_TOWER: STEP_DELTA and STEP_HEIGHT belong together")
        law = step_law(start, delta, height_mm) if delta else band_law(start, factor, band_mm)
        between = "" if is_traditional(command.upper()) else "="
        gcode_move = self.printer.lookup_object("gcode_move")
        tower = _Tower(
            gcode_move.transform,
            skip_mm,
            law,
            lambda value: self.gcode.run_script_from_command(f"{command} {parameter}{between}{value:.9f}"),
        )
        tower.on_end = self._end
        gcode_move.set_move_transform(tower, force=True)
        gcode_move.reset_last_position()
        self._tower = tower
        gcmd.respond_info(f"Starting tuning test (start={start:.6f} factor={factor:.6f} band={band_mm:.3f} "
                          f"step_delta={delta:.6f} step_height={height_mm:.3f} skip={skip_mm:.3f})")  # fmt: skip

    def _end(self) -> None:
        tower, self._tower = self._tower, None
        if tower is None:
            return
        gcode_move = self.printer.lookup_object("gcode_move")
        if gcode_move.transform is tower:
            gcode_move.set_move_transform(tower.following, force=True)
            gcode_move.reset_last_position()
        else:  # another transform is on top: stay, without effect
            tower._update = lambda z_mm: None  # type: ignore[method-assign]
        self.gcode.respond_info("Ending tuning test mode")


def load_config(config: ConfigWrapper) -> TuningTower:
    """Always loaded."""
    tower = TuningTower(config.get_printer())
    tower.register()
    return tower
