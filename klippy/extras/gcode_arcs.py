"""[gcode_arcs]: G2 and G3 as rows of short straight moves, in the plane chosen by G17 (XY), G18 (XZ) or G19 (YZ).

The centre is given by two of I, J, K, relative to the start. A helix moves evenly along the third axis. An arc without
a new position in its plane is a full circle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from configfile import ConfigWrapper
from gcode import GCodeCommand
from gcode_command import CommandError
from motionlimits import POSITION
from roles import Printer

AXES = "XYZ"
DEFAULT_RESOLUTION_MM = 1.0
MAX_PIECES = 100_000  # of an arc: all are worked out before the first moves


@dataclass(frozen=True, slots=True)
class Plane:
    """Axes of the plane in the order that makes G3 turn from the first to the second, and the axis of the helix."""

    first: int
    second: int
    helix: int


# As Klipper turns: with G18 from x to z, which is the other way round than RS274 has it.
PLANES = {"G17": Plane(0, 1, 2), "G18": Plane(0, 2, 1), "G19": Plane(1, 2, 0)}


def arc_points(
    plane: Plane,
    start: list[float],
    end: list[float],
    centre: tuple[float, float],
    clockwise: bool,
    step_mm: float,
) -> list[list[float]]:
    """Points (x, y, z) along the arc, the last one being `end`. centre: in the plane, relative to start."""
    a, b, c = plane.first, plane.second, plane.helix
    x0, y0 = start[a] + centre[0], start[b] + centre[1]
    from_angle = math.atan2(start[b] - y0, start[a] - x0)
    turn = math.atan2(end[b] - y0, end[a] - x0) - from_angle
    if clockwise and turn >= 0.0:
        turn -= 2.0 * math.pi
    elif not clockwise and turn <= 0.0:
        turn += 2.0 * math.pi
    if start[a] == end[a] and start[b] == end[b]:
        turn = -2.0 * math.pi if clockwise else 2.0 * math.pi
    radius = math.hypot(*centre)
    rise = end[c] - start[c]
    length = math.hypot(turn * radius, rise)
    count = max(1, math.floor(length / step_mm))
    if count > MAX_PIECES:
        raise CommandError(
            f"Arc too long: {length:g} mm; with pieces of {step_mm:g} mm ([gcode_arcs] resolution) it must have "
            f"maximum of {step_mm * MAX_PIECES:g} mm"
        )
    points = []
    for number in range(1, count):
        share = number / count
        point = list(start[:3])
        point[a] = x0 + radius * math.cos(from_angle + share * turn)
        point[b] = y0 + radius * math.sin(from_angle + share * turn)
        point[c] = start[c] + share * rise
        points.append(point)
    points.append(list(end[:3]))
    return points


class ArcSupport:
    """Printer object 'gcode_arcs'."""

    def __init__(self, printer: Printer, resolution_mm: float) -> None:
        self.printer = printer
        self.resolution_mm = resolution_mm
        self.plane_name = "G17"
        self.gcode = printer.lookup_object("gcode")
        self.gcode_move = printer.lookup_object("gcode_move")

    def register_commands(self) -> None:
        for name in PLANES:
            self.gcode.register_command(name, self.cmd_plane)
        self.gcode.register_command("G2", self.cmd_G2)
        self.gcode.register_command("G3", self.cmd_G3)

    def cmd_plane(self, gcmd: GCodeCommand) -> None:
        """G17, G18, G19: the plane of the arcs to come."""
        self.plane_name = gcmd.get_command()

    def cmd_G2(self, gcmd: GCodeCommand) -> None:
        """Clockwise arc."""
        self._arc(gcmd, True)

    def cmd_G3(self, gcmd: GCodeCommand) -> None:
        """Counterclockwise arc."""
        self._arc(gcmd, False)

    def _arc(self, gcmd: GCodeCommand, clockwise: bool) -> None:
        status = self.gcode_move.get_status()
        name = gcmd.get_command()
        if not status["absolute_coordinates"]:
            raise gcmd.error(f"{name} does not support relative move mode")
        if gcmd.get_float("R", None) is not None:
            raise gcmd.error(f"{name} does not support R moves")
        start = list(status["gcode_position"])
        end = [gcmd.get_float(axis, start[i], **POSITION) for i, axis in enumerate(AXES)]
        plane = PLANES[self.plane_name]
        letters = "IJK"[plane.first], "IJK"[plane.second]
        centre = gcmd.get_float(letters[0], 0.0, **POSITION), gcmd.get_float(letters[1], 0.0, **POSITION)
        if not any(centre):
            raise gcmd.error(
                f"{name} requires {' or '.join(sorted(letters))} parameters in plane {self.plane_name}"
            )
        points = arc_points(plane, start, end, centre, clockwise, self.resolution_mm)
        self._run(gcmd, points, start[3], status["absolute_extrude"])

    def _run(
        self, gcmd: GCodeCommand, points: list[list[float]], e_start: float, absolute_extrude: bool
    ) -> None:
        e_value = gcmd.get_float("E", None)
        speed = gcmd.get_float("F", None, above=0.0)
        for number, point in enumerate(points, 1):
            params = {axis: f"{value:.9f}" for axis, value in zip(AXES, point, strict=True)}
            if e_value is not None:
                share = number / len(points)
                e = e_start + (e_value - e_start) * share if absolute_extrude else e_value / len(points)
                params["E"] = f"{e:.9f}"
            if speed is not None:
                params["F"] = f"{speed:.6f}"
            self.gcode_move.cmd_G1(self.gcode.create_gcode_command("G1", "G1", params))


def load_config(config: ConfigWrapper) -> ArcSupport:
    config.get_printer().load_object(config, "gcode_move")
    arcs = ArcSupport(config.get_printer(), config.getfloat("resolution", DEFAULT_RESOLUTION_MM, above=0.0))
    arcs.register_commands()
    return arcs
