"""Moves of a G-code text as the host's look-ahead gives them out, and its offline plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import plan_temperature
from lookahead import Move
from simulation.path_host import PathHost, PathPrinter
from simulation.plan_offline import OfflinePlan, OfflineRun
from thermal.plan.path_pieces import PathPieces

FILAMENT_MM2 = math.pi / 4 * 1.75**2

# A config with what a look-ahead needs and nothing else.
CONFIG = """
[printer]
kinematics: cartesian
max_velocity: 200
max_accel: 3000
[extruder]
max_temp: 300
[temperature_plan]
material: ABS
features:
  external perimeter: 235
"""

LINES = """
M140 S90
M104 S240
G90
M83
;LAYER_CHANGE
;HEIGHT:0.3
G1 Z0.3 F600
;TYPE:External perimeter
G1 X20 Y0 F6000
G1 X60 Y0 E2.0 F3000
G1 X60 Y40 E2.0
EXCLUDE_OBJECT_START NAME=box
M104.1 S230
G1 X20 Y40 E2.0
EXCLUDE_OBJECT_END NAME=box
G4 P500
M104 S0
G1 X20 Y0 E2.0
"""


class Collected:
    """The reader that keeps all moves, and notes them for a plan."""

    def __init__(self) -> None:
        self.moves: list[Move] = []
        self.path = PathPieces(FILAMENT_MM2, longest_mm=10.0)

    def on_ready(self, printer: PathPrinter) -> None:
        toolhead = printer.lookup_object("toolhead")
        toolhead.register_move_listener(self._on_moves)
        toolhead.register_move_listener(self._on_records, as_records=True)

    def _on_moves(self, moves: Sequence[Move]) -> None:
        self.moves += moves

    def _on_records(self, row: Any, count: int, print_time: float) -> None:
        self.path.note_planned(row, count, print_time, 0.0, 0.0)

    def before_line(self, number: int) -> None:
        """All lines are alike."""

    def after_line(self) -> None:
        """The moves come by themselves."""


def written(folder: Path, gcode: str, config: str) -> tuple[Path, Path]:
    """(config, G-code) as files."""
    paths = folder / "printer.cfg", folder / "part.gcode"
    for path, text in zip(paths, (config, gcode), strict=True):
        path.write_text(text)
    return paths


def collected(folder: Path, gcode: str, config: str = CONFIG) -> Collected:
    """Raises what the host raises."""
    reader, (config_file, gcode_file) = Collected(), written(folder, gcode, config)
    PathHost(config_file, gcode_file).run(reader)
    return reader


def host_moves(folder: Path, gcode: str, config: str = CONFIG) -> list[Move]:
    return collected(folder, gcode, config).moves


def offline_plan(
    folder: Path, gcode: str, config: str = CONFIG, *options: str, base_c: float = 215.0
) -> OfflinePlan:
    """As scripts/plan_temperature.py plans it, with `options` of its command line."""
    config_file, gcode_file = written(folder, gcode, config)
    parsed = plan_temperature.parse([str(gcode_file), "--config", str(config_file), *options])
    access, settings, induction = plan_temperature.read_config(parsed)
    heater = parsed.heater or ("induction" if induction else "slow")
    nozzle = plan_temperature.limits_of(heater, access, settings)
    return OfflineRun(settings, nozzle, base_c).run(config_file, gcode_file)
