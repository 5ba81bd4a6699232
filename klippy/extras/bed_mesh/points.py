"""Which places a bed mesh is probed at, and what becomes of their heights. No printer here; mm throughout.

MeshShape ──plan()──► cells, each with one place (or, in a faulty region, up to four at its edges)
          ──adapted()──► a shape for the area of the objects to be printed
heights of the places ──► rows of heights, front row first, each from left to right
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..probing import surface_fit

Place = tuple[float, float]
MIN_COUNT = 3
ALGORITHMS = ("lagrange", "bicubic")


class MeshError(Exception):
    """A mesh cannot be as asked for; the text is for the user."""


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle in which probing gives wrong heights."""

    low: Place
    high: Place

    def holds(self, place: Place) -> bool:
        return all(a <= p <= b for a, p, b in zip(self.low, place, self.high, strict=True))

    def overlaps(self, other: Region) -> bool:
        return all(self.low[k] <= other.high[k] and other.low[k] <= self.high[k] for k in (0, 1))

    def edges_beside(self, place: Place) -> list[Place]:
        """The four points of the border on the level of `place`, in the order of a walk around."""
        x, y = place
        return [(self.low[0], y), (x, self.low[1]), (self.high[0], y), (x, self.high[1])]


@dataclass(frozen=True, slots=True)
class Cell:
    """One point of the mesh and where it is probed."""

    row: int
    column: int
    places: tuple[Place, ...]


@dataclass(frozen=True, slots=True)
class Layout:
    """What one run probes: the cells of a shape, then the reference if it lies outside of the mesh."""

    shape: MeshShape
    cells: tuple[Cell, ...]
    reference: Place | None = None

    def places(self) -> list[Place]:
        """In the order of probing."""
        places = [place for cell in self.cells for place in cell.places]
        return places if self.reference is None else [*places, self.reference]


@dataclass(frozen=True, slots=True)
class MeshShape:
    """Rectangle low..high (of the probe), points probed along x and y, and how to fill in between.

    radius: the bed is round, low..high is the square around the circle.
    """

    low: Place
    high: Place
    counts: tuple[int, int]
    pps: tuple[int, int] = (2, 2)
    algorithm: str = "lagrange"
    tension: float = 0.2
    radius: float | None = None

    @property
    def origin(self) -> Place:
        return 0.5 * (self.low[0] + self.high[0]), 0.5 * (self.low[1] + self.high[1])

    @staticmethod
    def round(origin: Place, radius: float, count: int, **more: Any) -> MeshShape:
        low, high = (origin[0] - radius, origin[1] - radius), (origin[0] + radius, origin[1] + radius)
        return MeshShape(low, high, (count, count), radius=radius, **more)

    def checked(self) -> MeshShape:
        """The shape with an algorithm that can do it. Raises MeshError."""
        if min(self.counts) < MIN_COUNT:
            raise MeshError(f"a mesh needs {MIN_COUNT} points along each axis at least")
        if self.radius is not None and self.counts[0] % 2 == 0:
            raise MeshError("round_probe_count must be odd: the centre is probed")
        if not (self.low[0] < self.high[0] and self.low[1] < self.high[1]):
            raise MeshError("mesh_min must be below mesh_max in x and in y")
        if self.pps == (0, 0):
            return self
        few, many = min(self.counts), max(self.counts)
        algorithm = self.algorithm
        if algorithm == "bicubic" and few < surface_fit.BICUBIC_MIN:
            algorithm = "lagrange"
        if algorithm == "lagrange" and many > surface_fit.LAGRANGE_MAX:
            advice = "use algorithm bicubic" if few >= surface_fit.BICUBIC_MIN else "probe 4 points at least"
            raise MeshError(
                f"{self.counts[0]} x {self.counts[1]} points are too many for lagrange interpolation, which goes to "
                f"{surface_fit.LAGRANGE_MAX}; {advice}"
            )
        return replace(self, algorithm=algorithm)

    # -- where to probe --

    def _point(self, row: int, column: int) -> Place:
        share_x, share_y = column / (self.counts[0] - 1), row / (self.counts[1] - 1)
        return (
            self.low[0] + share_x * (self.high[0] - self.low[0]),
            self.low[1] + share_y * (self.high[1] - self.low[1]),
        )

    def holds(self, place: Place) -> bool:
        """Is the place within the rectangle?"""
        return all(a <= p <= b for a, p, b in zip(self.low, place, self.high, strict=True))

    def _is_on_bed(self, place: Place) -> bool:
        if self.radius is None:
            return self.holds(place)
        # the outermost points of the axes lie on the circle itself
        return math.dist(place, self.origin) <= self.radius * (1.0 + 1e-9)

    def plan(self, faulty: Sequence[Region] = (), reference: Place | None = None) -> Layout:
        """Every point of the mesh, row by row, to and fro. Raises MeshError."""
        if reference is not None and self.holds(reference):
            reference = None  # its height follows from the mesh
        if reference is not None and any(region.holds(reference) for region in faulty):
            raise MeshError("zero_reference_position lies in a faulty region")
        cells = []
        for row in range(self.counts[1]):
            columns = range(self.counts[0])
            for column in reversed(columns) if row % 2 else columns:
                place = self._point(row, column)
                if self._is_on_bed(place):
                    cells.append(Cell(row, column, self._around(place, faulty, -1.0 if row % 2 else 1.0)))
        return Layout(self, tuple(cells), reference)

    def _around(self, place: Place, faulty: Sequence[Region], way: float) -> tuple[Place, ...]:
        """The place itself, or those at the edge of the faulty region it is in, in the way of its row along x."""
        region = next((r for r in faulty if r.holds(place)), None)
        if region is None:
            return (place,)
        places = tuple(edge for edge in region.edges_beside(place) if self._is_on_bed(edge))
        if not places:
            raise MeshError(
                f"the faulty region about {place[0]:.1f}, {place[1]:.1f} leaves no place to probe"
            )
        return tuple(sorted(dict.fromkeys(places), key=lambda edge: (way * edge[0], edge[1])))

    # -- what was found --

    def rows(self, cells: Sequence[Cell], heights: Sequence[float]) -> surface_fit.Matrix:
        """Heights of the places, in the plan's order, as rows; beyond a round bed's edge as at the edge."""
        given = iter(heights)
        known: dict[tuple[int, int], float] = {}
        for cell in cells:
            of_cell = [next(given) for _ in cell.places]
            known[cell.row, cell.column] = sum(of_cell) / len(of_cell)
        rows = []
        for row in range(self.counts[1]):
            columns = [c for c in range(self.counts[0]) if (row, c) in known]
            first, last = columns[0], columns[-1]
            rows.append([known[row, min(max(c, first), last)] for c in range(self.counts[0])])
        return rows

    def surface(self, rows: Sequence[Sequence[float]]) -> surface_fit.Surface:
        """The refined surface through rows of probed heights."""
        if self.algorithm == "bicubic":
            weights = [
                surface_fit.bicubic_weights(n, pps, self.tension)
                for n, pps in zip(self.counts, self.pps, strict=True)
            ]
        else:
            weights = [
                surface_fit.lagrange_weights(n, pps) for n, pps in zip(self.counts, self.pps, strict=True)
            ]
        return surface_fit.Surface(self.low, self.high, surface_fit.refine(rows, *weights))

    # -- adaptive --

    def adapted(self, corners: Sequence[Place], margin: float) -> MeshShape:
        """A shape for the area around these points, no larger than this one, with points as dense. Raises MeshError."""
        low = tuple(max(self.low[k], min(c[k] for c in corners) - margin) for k in (0, 1))
        high = tuple(min(self.high[k], max(c[k] for c in corners) + margin) for k in (0, 1))
        if not (low[0] < high[0] and low[1] < high[1]):
            raise MeshError("the objects to be printed lie outside of the mesh")
        if self.radius is not None:
            return self._adapted_round((low[0], low[1]), (high[0], high[1]))
        shares = [(high[k] - low[k]) / (self.high[k] - self.low[k]) for k in (0, 1)]
        counts = [max(MIN_COUNT, math.ceil(n * share)) for n, share in zip(self.counts, shares, strict=True)]
        if max(counts) > surface_fit.LAGRANGE_MAX:  # then it has to be bicubic
            counts = [max(surface_fit.BICUBIC_MIN, n) for n in counts]
        return replace(
            self, low=(low[0], low[1]), high=(high[0], high[1]), counts=(counts[0], counts[1])
        ).checked()

    def _adapted_round(self, low: Place, high: Place) -> MeshShape:
        """The circle around a rectangle, as far as it fits into this one."""
        assert self.radius is not None
        origin = 0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1])
        radius = min(0.5 * math.dist(low, high), self.radius - math.dist(origin, self.origin))
        if radius <= 0.0:
            raise MeshError("the objects to be printed lie outside of the mesh")
        count = max(MIN_COUNT, math.ceil(self.counts[0] * radius / self.radius)) | 1
        return MeshShape.round(
            origin, radius, count, pps=self.pps, algorithm=self.algorithm, tension=self.tension
        ).checked()
