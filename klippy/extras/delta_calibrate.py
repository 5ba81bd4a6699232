"""[delta_calibrate]: finds the dimensions of a delta from probed heights and from distances on a printed object.

DELTA_CALIBRATE probes seven places: they give the towers' angles and endstops and the delta radius. DELTA_ANALYZE
takes what a calliper measured on the printed object: it gives the arms' lengths, too. What was measured is saved in
steps from the endstops (kinematics/delta_calibration.py), so later calibrations use it again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from kinematics.delta_calibration import Calibration, Steps

from . import manual_probe
from .probing.least_squares import fit
from .probing.points import ProbePointsHelper

# The object: six pillars around one, this far from it (mm), from the label "A" on counterclockwise (degrees).
PILLAR_RADIUS_MM = 65.0
PILLAR_ANGLES = (210.0, 270.0, 330.0, 30.0, 90.0, 150.0)
# Parameters of DELTA_ANALYZE: how many numbers each has
MEASURES = {"CENTER_DISTS": 6, "OUTER_DISTS": 6, "CENTER_PILLAR_WIDTHS": 3, "OUTER_PILLAR_WIDTHS": 6}


@dataclass(frozen=True, slots=True)
class Height:
    """The nozzle was this high above the bed with the motors there."""

    height: float
    steps: Steps


@dataclass(frozen=True, slots=True)
class Distance:
    """Two places of the nozzle that are this far apart."""

    distance: float
    steps1: Steps
    steps2: Steps


@dataclass(slots=True)
class Measured:
    """All that is known of a machine; mm."""

    heights: list[Height] = field(default_factory=list)  # of the last DELTA_CALIBRATE
    manual: list[Height] = field(default_factory=list)
    distances: list[Distance] = field(default_factory=list)

    @staticmethod
    def read(config: ConfigWrapper) -> Measured:
        """What an earlier calibration saved."""
        found = Measured()
        for prefix, heights in (("height", found.heights), ("manual_height", found.manual)):
            while (height := config.getfloat(f"{prefix}{len(heights)}", None)) is not None:
                steps = config.getfloatlist(f"{prefix}{len(heights)}_pos", count=3)
                heights.append(Height(height, steps))
        while (distance := config.getfloat(f"distance{len(found.distances)}", None, above=0.0)) is not None:
            name = f"distance{len(found.distances)}_pos"
            ends = [config.getfloatlist(f"{name}{end}", count=3) for end in (1, 2)]
            found.distances.append(Distance(distance, *ends))
        return found

    def saved(self) -> dict[str, str]:
        """Options of the section."""
        options: dict[str, str] = {}
        for prefix, heights in (("height", self.heights), ("manual_height", self.manual)):
            for number, at in enumerate(heights):
                options[f"{prefix}{number}"] = f"{at.height:.6f}"
                options[f"{prefix}{number}_pos"] = _text(at.steps)
        for number, between in enumerate(self.distances):
            options[f"distance{number}"] = f"{between.distance:.6f}"
            options[f"distance{number}_pos1"] = _text(between.steps1)
            options[f"distance{number}_pos2"] = _text(between.steps2)
        return options

    def residuals(self, machine: Calibration, parameters: Mapping[str, float]) -> list[float]:
        """mm by which the parameters miss what was measured."""
        found = [
            machine.place_at(parameters, at.steps)[2] - at.height for at in (*self.heights, *self.manual)
        ]
        for between in self.distances:
            ends = [machine.place_at(parameters, steps) for steps in (between.steps1, between.steps2)]
            found.append(math.dist(*ends) - between.distance)
        return found


def _text(steps: Steps) -> str:
    return ",".join(f"{count:.3f}" for count in steps)


def object_distances(
    machine: Calibration, measures: Mapping[str, Sequence[float]], scale: float
) -> list[Distance]:
    """Distances between the middles of the pillars, from what a calliper says of their outer sides."""
    middle = machine.steps_at(machine.parameters, (0.0, 0.0, 0.0))
    radius = PILLAR_RADIUS_MM * scale
    pillars = [
        machine.steps_at(
            machine.parameters,
            (radius * math.cos(math.radians(angle)), radius * math.sin(math.radians(angle)), 0.0),
        )
        for angle in PILLAR_ANGLES
    ]
    outer = measures["OUTER_PILLAR_WIDTHS"]
    # the spoke of the pillar across from C is that of C: A, C, B, A, C, B
    center = [measures["CENTER_PILLAR_WIDTHS"][spoke] for spoke in (0, 2, 1, 0, 2, 1)]
    found = []
    for number, steps in enumerate(pillars):
        following = (number + 1) % len(pillars)
        to_middle = measures["CENTER_DISTS"][number] - 0.5 * (center[number] + outer[number])
        to_next = measures["OUTER_DISTS"][number] - 0.5 * (outer[number] + outer[following])
        found.append(Distance(to_middle, middle, steps))
        found.append(Distance(to_next, steps, pillars[following]))
    return found


class DeltaCalibrate:
    """Printer object 'delta_calibrate'."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        radius = config.getfloat("radius", above=0.0)
        around = [math.radians(angle) for angle in PILLAR_ANGLES]
        points = [(0.0, 0.0), *((radius * math.cos(a), radius * math.sin(a)) for a in around)]
        self.points = ProbePointsHelper(config, self._finish_probing, default_points=points)
        self.points.minimum_points(3)
        self.measured = Measured.read(config)
        self._measures: dict[str, Sequence[float]] = {}
        self._scale = 1.0
        self._gcmd: Any = None
        self.printer.register_event_handler("klippy:connect", self._find_machine)
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command("DELTA_CALIBRATE", self.cmd_DELTA_CALIBRATE, desc="Delta calibration script")
        gcode.register_command(
            "DELTA_ANALYZE", self.cmd_DELTA_ANALYZE, desc="Extended delta calibration tool"
        )

    def _find_machine(self) -> None:
        kin = self.printer.lookup_object("toolhead").get_kinematics()
        if not hasattr(kin, "get_calibration"):
            raise self.printer.config_error(
                "Section 'delta_calibrate' is for kinematics delta and rotary_delta only"
            )
        self._kin = kin

    def _note(self, gcmd: GCodeCommand, parameters: Mapping[str, float]) -> None:
        """Into the config, with the next SAVE_CONFIG."""
        machine = self._kin.get_calibration()
        configfile = self.printer.lookup_object("configfile")
        for option, text in self.measured.saved().items():
            configfile.set("delta_calibrate", option, text)
        for section, option, text in machine.saved(parameters):
            configfile.set(section, option, text)
        changes = "\n".join(
            f"{name}: {machine.parameters[name]:.6f} -> {value:.6f}" for name, value in parameters.items()
        )
        manual_probe.report_save_config(gcmd, changes)

    def _calibrate(self, gcmd: GCodeCommand, extended: bool) -> None:
        machine = self._kin.get_calibration()
        if len(self.measured.heights) < 3:
            raise gcmd.error("There are no heights yet: run DELTA_CALIBRATE and SAVE_CONFIG first")

        def residuals(parameters: Mapping[str, float]) -> list[float]:
            return self.measured.residuals(machine, parameters)

        before = residuals(machine.parameters)
        found = fit(machine.parameters, machine.extended if extended else machine.basic, residuals)
        after = residuals(found)
        gcmd.respond_info(
            f"Calibration of {len(after)} measurements: largest error {max(map(abs, before)):.4f} mm before, "
            f"{max(map(abs, after)):.4f} mm after"
        )
        self._note(gcmd, found)

    # -- heights --

    def cmd_DELTA_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """DELTA_CALIBRATE [METHOD=manual] [HORIZONTAL_MOVE_Z=mm]."""
        self._gcmd = gcmd
        self.points.start_probe(gcmd)

    def _finish_probing(self, offsets: Sequence[float], places: list[list[float]]) -> None:
        machine = self._kin.get_calibration()
        self.measured.heights = [
            Height(0.0, machine.steps_at(machine.parameters, (x, y, z - offsets[2]))) for x, y, z in places
        ]
        self._calibrate(self._gcmd, extended=bool(self.measured.distances))

    # -- distances --

    def cmd_DELTA_ANALYZE(self, gcmd: GCodeCommand) -> None:
        """DELTA_ANALYZE [CENTER_DISTS=...] [OUTER_DISTS=...] [CENTER_PILLAR_WIDTHS=...] [OUTER_PILLAR_WIDTHS=...]
        [SCALE=] [MANUAL_HEIGHT=mm] [CALIBRATE=extended]."""
        given = {name: self._numbers(gcmd, name, count) for name, count in MEASURES.items()}
        scale = gcmd.get_float("SCALE", self._scale, above=0.0)
        manual_mm = gcmd.get_float("MANUAL_HEIGHT", None)
        calibrate = gcmd.get("CALIBRATE", None)
        if calibrate not in (None, "extended"):
            raise gcmd.error(f"CALIBRATE is '{calibrate}'; it can be extended")
        self._measures |= {name: numbers for name, numbers in given.items() if numbers is not None}
        self._scale = scale
        if manual_mm is not None:
            self._add_manual(gcmd, manual_mm)
        if calibrate:
            self._analyze(gcmd)

    @staticmethod
    def _numbers(gcmd: GCodeCommand, name: str, count: int) -> Sequence[float] | None:
        text = gcmd.get(name, None)
        if text is None:
            return None
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) != count or not all(n > 0.0 and math.isfinite(n) for n in numbers):
            raise gcmd.error(f"{name} is '{text}'; it must be {count} lengths in mm, separated by commas")
        return numbers

    def _add_manual(self, gcmd: GCodeCommand, height_mm: float) -> None:
        """The user measured how high the nozzle is now."""
        machine = self._kin.get_calibration()
        place = manual_probe.kinematic_position(self.printer)
        self.measured.manual.append(Height(height_mm, machine.steps_at(machine.parameters, place)))
        gcmd.respond_info(
            f"Height {height_mm:.3f} at {place[0]:.3f},{place[1]:.3f},{place[2]:.3f}: calibrations use it from now on"
        )

    def _analyze(self, gcmd: GCodeCommand) -> None:
        missing = [name for name in MEASURES if name not in self._measures]
        if missing:
            raise gcmd.error(f"Not measured yet: {', '.join(missing)}")
        distances = object_distances(self._kin.get_calibration(), self._measures, self._scale)
        for number, between in enumerate(distances):
            if not between.distance > 0.0:
                raise gcmd.error(f"Measured distance {number} is shorter than the pillars are wide")
        before, self.measured.distances = self.measured.distances, distances
        try:
            self._calibrate(gcmd, extended=True)
        except self.printer.command_error:
            self.measured.distances = before
            raise


def load_config(config: ConfigWrapper) -> DeltaCalibrate:
    return DeltaCalibrate(config)
