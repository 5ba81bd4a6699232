"""The part of `make demo`: a lighthouse, sliced here. What a nozzle has to do is in it:

foundation   walls, solid layers, sparse infill at speed: the flow changes all the time
tower        walls that become narrower, little infill
gallery      an overhang of 45 degrees, the fan at full speed, then a solid floor
lantern      one wall; roof: layers so small that each one slows the head down
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

Point = tuple[float, float]

CENTRE_MM = 90.0
LAYER_MM, WIDTH_MM = 0.25, 0.45
FILAMENT_MM2 = math.pi * 0.875**2
HOT_C, FIRST_C, BED_C = 220, 230, 60
RETRACT_MM, RETRACT_MM_S, TRAVEL_MM_S = 0.6, 30.0, 120.0
WALL_MM_S, INNER_MM_S, INFILL_MM_S, FIRST_MM_S, SLOWEST_MM_S = 40.0, 60.0, 80.0, 25.0, 10.0
LAYER_TIME_S = 3.0
RETRACT_FROM_MM = 2.0
POINTS = 60  # of an outline


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of the height: its outline goes from one radius to another; `power` 2 is a circle, more is squarer."""

    name: str
    top_mm: float
    begin_mm: float
    end_mm: float
    walls: int
    infill: float  # share of the area; 1: solid
    solid_ends: int = 0  # solid layers at its bottom and top
    power: float = 2.0
    fan: int = 180


STAGES = (
    Stage("foundation", 3.0, 11.0, 11.0, 2, 0.25, solid_ends=2, power=6.0),
    Stage("tower", 19.0, 7.5, 5.0, 2, 0.15),
    Stage("gallery", 22.0, 5.0, 8.0, 2, 0.15, fan=255),
    Stage("gallery floor", 22.75, 8.0, 8.0, 2, 1.0, fan=255),
    Stage("lantern", 27.0, 3.5, 3.5, 1, 0.0),
    Stage("roof", 32.0, 4.5, 0.7, 1, 0.0, fan=255),
)


@dataclass(slots=True)
class Path:
    """A line of one kind."""

    kind: str
    points: list[Point]
    speed_mm_s: float

    @property
    def length_mm(self) -> float:
        return sum(math.dist(a, b) for a, b in pairwise(self.points))


def outline(radius_mm: float, power: float) -> list[Point]:
    """A closed superellipse around the origin."""
    points = []
    for number in range(POINTS + 1):
        angle = 2.0 * math.pi * number / POINTS
        x, y = math.cos(angle), math.sin(angle)
        scale = radius_mm / (abs(x) ** power + abs(y) ** power) ** (1.0 / power)
        points.append((x * scale, y * scale))
    return points


def zigzag(radius_mm: float, power: float, share: float, angle: float) -> list[Point]:
    """Infill lines of a convex outline, joined at their ends."""
    cosine, sine = math.cos(angle), math.sin(angle)
    turned = [(x * cosine + y * sine, y * cosine - x * sine) for x, y in outline(radius_mm, power)]
    step, low = WIDTH_MM / share, min(y for _, y in turned)
    points: list[Point] = []
    for number in range(int(-2.0 * low / step)):
        y = low + (number + 0.5) * step
        ends = [
            a[0] + (b[0] - a[0]) * (y - a[1]) / (b[1] - a[1])
            for a, b in pairwise(turned)
            if (a[1] < y) != (b[1] < y)
        ]
        if len(ends) >= 2:
            ends.sort(reverse=number % 2 == 1)
            points += [(ends[0], y), (ends[-1], y)]
    return [(x * cosine - y * sine, x * sine + y * cosine) for x, y in points]


def layer_paths(stage: Stage, share_of_stage: float, number: int, is_solid: bool) -> list[Path]:
    """Walls from the inside out, then the infill."""
    radius_mm = stage.begin_mm + (stage.end_mm - stage.begin_mm) * share_of_stage
    paths = []
    for wall in reversed(range(stage.walls)):
        kind, speed = ("Perimeter", INNER_MM_S) if wall else ("External perimeter", WALL_MM_S)
        paths.append(Path(kind, outline(radius_mm - (wall + 0.5) * WIDTH_MM, stage.power), speed))
    share = 1.0 if is_solid else stage.infill
    inner_mm = radius_mm - (stage.walls + 0.3) * WIDTH_MM
    if share and inner_mm > WIDTH_MM:
        points = zigzag(inner_mm, stage.power, share, math.pi / 4 * (1 if number % 2 else -1))
        paths.append(Path("Solid infill" if share == 1.0 else "Internal infill", points, INFILL_MM_S))
    return [path for path in paths if len(path.points) > 1]


def slow_down(paths: Iterable[Path], is_first: bool) -> list[Path]:
    """The speeds of a layer: the first one slowly, and none sooner than its minimum time."""
    kept = list(paths)
    for path in kept if is_first else ():
        path.speed_mm_s = FIRST_MM_S
    factor = min(1.0, sum(path.length_mm / path.speed_mm_s for path in kept) / LAYER_TIME_S)
    for path in kept:
        path.speed_mm_s = max(min(SLOWEST_MM_S, path.speed_mm_s), path.speed_mm_s * factor)
    return kept


@dataclass(slots=True)
class _Writer:
    """G-code of paths, with relative extrusion."""

    lines: list[str] = field(default_factory=list)
    at: Point = (0.0, 0.0)

    def path(self, path: Path, z_mm: float) -> None:
        start = path.points[0]
        far = math.dist(self.at, start) > RETRACT_FROM_MM
        if far:
            self.lines.append(f"G1 E-{RETRACT_MM} F{60 * RETRACT_MM_S:.0f}")
        self._go(start, f"Z{z_mm:.2f} F{60 * TRAVEL_MM_S:.0f}")
        if far:
            self.lines.append(f"G1 E{RETRACT_MM} F{60 * RETRACT_MM_S:.0f}")
        self.lines.append(f";TYPE:{path.kind}")
        for number, point in enumerate(path.points[1:]):
            filament_mm = math.dist(self.at, point) * LAYER_MM * WIDTH_MM / FILAMENT_MM2
            feed = f" F{60 * path.speed_mm_s:.0f}" if number == 0 else ""
            self._go(point, f"E{filament_mm:.5f}{feed}")

    def _go(self, point: Point, rest: str) -> None:
        self.at = point
        self.lines.append(f"G1 X{CENTRE_MM + point[0]:.3f} Y{CENTRE_MM + point[1]:.3f} {rest}")


def layers() -> Iterator[tuple[Stage, float, list[Path]]]:
    """Each layer: its stage, its height and what is printed in it."""
    number, bottom_mm = 0, 0.0
    for stage in STAGES:
        count = round((stage.top_mm - bottom_mm) / LAYER_MM)
        for index in range(count):
            is_solid = min(index, count - 1 - index) < stage.solid_ends
            paths = layer_paths(stage, index / max(1, count - 1), number, is_solid)
            yield stage, bottom_mm + (index + 1) * LAYER_MM, slow_down(paths, number == 0)
            number += 1
        bottom_mm = stage.top_mm


def gcode() -> str:
    """The file."""
    writer = _Writer([
        "; A lighthouse: walls, infill, an overhang, small layers",
        f"; layer_height = {LAYER_MM}",
        f"M140 S{BED_C}", "G28", "G90", "M83", "G1 Z5 F600", f"M190 S{BED_C}", f"M109 S{FIRST_C}",
    ])  # fmt: skip
    fan = 0
    for number, (stage, z_mm, paths) in enumerate(layers()):
        writer.lines += [";LAYER_CHANGE", f";Z:{z_mm:.2f}", f";HEIGHT:{LAYER_MM}"]
        if number == 1:
            writer.lines.append(f"M104 S{HOT_C}")
        if number > 1 and stage.fan != fan:
            fan = stage.fan
            writer.lines.append(f"M106 S{fan}")
        for path in paths:
            writer.path(path, z_mm)
    return "\n".join([*writer.lines, "G1 E-2 F1800", "G1 Z60 F600", "M400", "M104 S0", "M140 S0", "M107", ""])
