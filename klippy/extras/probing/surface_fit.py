"""The mathematics of levelling: planes through points, and a surface through a grid of heights. mm throughout.

Both interpolations of a grid are linear in the heights, so each is a matrix of weights: with W_x (fine columns x probed
columns) and W_y, the fine grid is W_y Z W_x^T. Between the points of the fine grid heights are bilinear.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import chelper
from kinematics.carriages import solve

Matrix = list[list[float]]
# Polynomials through more points than this swing between them (Runge); Klipper's limit.
LAGRANGE_MAX = 6
# A cubic piece looks at two points to either side.
BICUBIC_MIN = 4


# ---- planes ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Plane:
    """z = height + slope_x * x + slope_y * y."""

    height: float
    slope_x: float
    slope_y: float

    def z(self, x: float, y: float) -> float:
        return self.height + self.slope_x * x + self.slope_y * y


def on_a_line(points: Sequence[Sequence[float]]) -> bool:
    """Do all points lie on one line (or in one place)?"""
    xx, yy, xy = _moments(points)
    return xx * yy - xy * xy <= 1e-9 * (xx + yy) ** 2


def _moments(points: Sequence[Sequence[float]]) -> tuple[float, float, float]:
    """Second moments about the mean: of x, of y, mixed."""
    mean_x = sum(p[0] for p in points) / len(points)
    mean_y = sum(p[1] for p in points) / len(points)
    return (
        sum((p[0] - mean_x) ** 2 for p in points),
        sum((p[1] - mean_y) ** 2 for p in points),
        sum((p[0] - mean_x) * (p[1] - mean_y) for p in points),
    )


def fit_plane(points: Sequence[Sequence[float]], heights: Sequence[float]) -> Plane:
    """Least squares; through points on a line the plane that is level across it. ValueError for a single place."""
    n = len(points)
    mean_x, mean_y = sum(p[0] for p in points) / n, sum(p[1] for p in points) / n
    mean_z = sum(heights) / n
    xx, yy, xy = _moments(points)
    xz = sum((p[0] - mean_x) * (h - mean_z) for p, h in zip(points, heights, strict=True))
    yz = sum((p[1] - mean_y) * (h - mean_z) for p, h in zip(points, heights, strict=True))
    if not on_a_line(points):
        slope_x, slope_y = solve(((xx, xy), (xy, yy)), (xz, yz), 1e-12 * (xx + yy))
    elif xx + yy > 0.0:
        # with t the place along the line: sum t*t is xx + yy, and (xz, yz) is sum t*z in the direction of the line
        slope_x, slope_y = xz / (xx + yy), yz / (xx + yy)
    else:
        raise ValueError("one place determines no plane")
    return Plane(mean_z - slope_x * mean_x - slope_y * mean_y, slope_x, slope_y)


def fit_twisted(
    points: Sequence[Sequence[float]], heights: Sequence[float]
) -> Callable[[float, float], float]:
    """The surface a + b x + c y + d x y through four points; ValueError if they determine none."""
    mid_x = sum(p[0] for p in points) / len(points)
    mid_y = sum(p[1] for p in points) / len(points)
    size = max(max(abs(p[0] - mid_x), abs(p[1] - mid_y)) for p in points) or 1.0

    def terms(x: float, y: float) -> tuple[float, float, float, float]:
        u, v = (x - mid_x) / size, (y - mid_y) / size
        return 1.0, u, v, u * v

    factors = solve([terms(p[0], p[1]) for p in points], heights, 1e-12)
    return lambda x, y: sum(f * t for f, t in zip(factors, terms(x, y), strict=True))


# ---- interpolation ---------------------------------------------------------------------------------------------


def lagrange_weights(count: int, per_segment: int) -> Matrix:
    """Rows: the fine points of an axis; columns: `count` equidistant probed ones. One polynomial through all."""
    rows = []
    for place in _fine_places(count, per_segment):
        row = []
        for node in range(count):
            others = [k for k in range(count) if k != node]
            row.append(math.prod((place - k) / (node - k) for k in others))
        rows.append(row)
    return rows


def bicubic_weights(count: int, per_segment: int, tension: float) -> Matrix:
    """As above, piece by piece: cubics whose slope at a point is tension * (next - previous).

    At the ends, where there is no next, the end itself takes its place.
    """
    rows = []
    for place in _fine_places(count, per_segment):
        left = min(int(place), count - 2)
        t = place - left
        row = [0.0] * count
        # Hermite's four base polynomials: value and slope to the left, value and slope to the right
        row[left] += (1 + 2 * t) * (1 - t) ** 2
        row[left + 1] += t * t * (3 - 2 * t)
        for node, share in ((left, t * (1 - t) ** 2), (left + 1, t * t * (t - 1))):
            row[min(node + 1, count - 1)] += tension * share
            row[max(node - 1, 0)] -= tension * share
        rows.append(row)
    return rows


def _fine_places(count: int, per_segment: int) -> list[float]:
    """Places of the fine points, in segments from the first probed point."""
    pieces = per_segment + 1
    return [k / pieces for k in range((count - 1) * pieces + 1)]


def refine(probed: Sequence[Sequence[float]], across: Matrix, along: Matrix) -> Matrix:
    """The fine grid: `across` are the weights of columns (x), `along` those of rows (y)."""
    wide = [[sum(w * z for w, z in zip(ws, row, strict=True)) for ws in across] for row in probed]
    columns = list(zip(*wide, strict=True))
    return [[sum(w * z for w, z in zip(ws, column, strict=True)) for column in columns] for ws in along]


class Surface:
    """Heights on a grid over a rectangle, bilinear between; beyond its edge as at the edge. `record` is the surface as
    the C helper has it (path_stage.h)."""

    def __init__(self, low: Sequence[float], high: Sequence[float], heights: Matrix) -> None:
        self.low, self.high = tuple(low), tuple(high)
        self.heights = heights
        self._columns, self._rows = len(heights[0]), len(heights)
        ffi, self._lib = chelper.get_ffi()
        self._flat = ffi.new("double[]", [z for row in heights for z in row])  # the record only points to it
        self.record = ffi.new("struct bed_surface *")
        self.record.heights = self._flat
        self.record.columns, self.record.rows = self._columns, self._rows
        self.record.low = self.low
        self.record.per_mm = (
            (self._columns - 1) / (high[0] - low[0]),
            (self._rows - 1) / (high[1] - low[1]),
        )

    def follow(self, fade: Fade, shift: Sequence[float], check_distance: float, max_change: float) -> None:
        """How split_line goes along this surface: looked up at x, y and (for the fade) z plus `shift`."""
        record = self.record
        record.fade_start, record.fade_end, record.fade_target = fade.start, fade.end, fade.target
        record.shift = tuple(shift)
        record.check_distance, record.max_change = check_distance, max_change

    def holds(self, x: float, y: float) -> bool:
        """Is the point within the rectangle?"""
        return self.low[0] <= x <= self.high[0] and self.low[1] <= y <= self.high[1]

    def z(self, x: float, y: float) -> float:
        return self._lib.bed_height(self.record, x, y)

    def raised(self, by: float) -> Surface:
        """The same surface, higher by `by`."""
        return Surface(self.low, self.high, [[z + by for z in row] for row in self.heights])

    def range(self) -> tuple[float, float]:
        """Lowest and highest of the grid."""
        return min(map(min, self.heights)), max(map(max, self.heights))

    def mean(self) -> float:
        return sum(map(sum, self.heights)) / (self._columns * self._rows)


# ---- following the surface -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Fade:
    """How a correction is taken back with the height of the print: all below `start`, `target` alone above `end`."""

    start: float = math.inf
    end: float = math.inf
    target: float = 0.0

    def allows(self, lowest: float, highest: float) -> bool:
        """Does z + correction rise with z everywhere on a surface of that range?"""
        return max(self.target - lowest, highest - self.target) < self.end - self.start

    def undo(self, corrected: float, surface_z: float, shift: float = 0.0) -> float:
        """The z for which z + correction(z + shift, surface_z) is `corrected`."""
        z = corrected - surface_z
        if z + shift <= self.start:
            return z
        z = corrected - self.target
        if z + shift >= self.end:
            return z
        # in between: z + target + (end - shift - z) * rise = corrected
        rise = (surface_z - self.target) / (self.end - self.start)
        return (corrected - self.target - (self.end - shift) * rise) / (1.0 - rise)


def split_line(surface: Surface, start: Sequence[float], end: Sequence[float]) -> list[list[float]]:
    """Corrected corners of the path from start (not given again) to end; a place is x, y, z, e and what else moves.

    The correction is looked at every `check_distance` along the bed, and where it has changed by `max_change` since
    the last corner there is a new one (`Surface.follow`).
    """
    ffi, lib = chelper.get_ffi()
    walk, place = ffi.new("struct bed_walk *"), ffi.new("double[4]")
    lib.bed_walk_begin(walk, surface.record, start[:4], end[:4])
    corners: list[list[float]] = []
    while lib.bed_walk_next(walk, place):
        further = [s + walk.share * (e - s) for s, e in zip(start[4:], end[4:], strict=True)]
        corners.append([*place, *further])
    return corners
