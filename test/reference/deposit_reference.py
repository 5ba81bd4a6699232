"""Where and when material was deposited, and how warm it still is when the next road touches it.

A deposited road gives its heat to the layer below and to the air. The lower layers are warm from all that came before.
Each column of the map keeps its stack, layer by layer, as nodes of a heat balance (`Column`), advanced when touched:

    rho c d_i dT_i/dt = k/(distance) (T_i-1 - T_i) + k/(distance) (T_i+1 - T_i) - side h d_i (T_i - Te)
                         - h (T_0 - Te) for the top one

`side`: open flanks per volume, 2/width for a single wall, none in a filled layer; read from how much of the column the
last layer filled. The lowest node lies on the bed, or, higher up, hands nothing on but its own material.

The newest node stands for the upper face of its road, which is what the next layer meets. The tests hold it to the
exact solution of a layer on a half space (within 1 degC from d^2/alpha on, 7 after a quarter of that), to a wall's
cross section in two dimensions, and to an infrared measurement.

The map keeps its last layers only: memory goes with the area of the part, not with the number of moves.
This is the readable form; a print runs thermal/plan/deposit.c, which the tests hold to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from thermal.plan.deposit import Surroundings
from thermal.plan.materials import Material

NODES = 6  # the lowest holds all that is below the others ...
FAR_MM = 3.0  # ... down to here: heat of 0.09 mm2/s takes 100 s to come back from there
FIRST_STEP = 0.4  # of a layer's d^2/alpha; later steps grow as the field smooths
GROWTH = 2.5
GAMMA = 1.0 - math.sqrt(0.5)
MIN_COVER = 0.05
MIN_MM2 = 1e-6


@dataclass(slots=True)
class Column:
    """A stack of layers, the newest first."""

    time_s: float  # when its temperatures were true
    z_mm: float
    odometer_mm: float  # path of the head when it was last here
    met_c: float  # what the present pass met
    area_mm2: float  # of it that the newest layer has filled so far
    below_mm2: float = 0.0  # that the layer below had filled at last; 0: none below
    side_per_mm: float = 0.0
    thick_mm: list[float] = field(default_factory=list)
    temp_c: list[float] = field(default_factory=list)

    @property
    def cover(self) -> float:
        """How much of the layer below the newest has covered, 0..1."""
        if self.below_mm2 <= 0.0:
            return 1.0
        return min(1.0, max(MIN_COVER, self.area_mm2 / self.below_mm2))


def _step(
    mass: list[float],
    link: list[float],
    out: list[float],
    gain: list[float],
    temps: list[float],
    step_s: float,
) -> list[float]:
    """mass T' = gain - (links + out) T over one step: two stages with the same matrix, second order, no ringing.

    Alexander 1977, SIAM J. Numer. Anal. 14, 1006: diagonally implicit, gamma = 1 - 1/sqrt(2), L-stable.
    """
    part_s = GAMMA * step_s
    first = _solve(
        mass, link, out, [m * t + part_s * g for m, t, g in zip(mass, temps, gain, strict=True)], part_s
    )
    between = [t + (1.0 - GAMMA) / GAMMA * (u - t) for t, u in zip(temps, first, strict=True)]
    return _solve(
        mass, link, out, [m * t + part_s * g for m, t, g in zip(mass, between, gain, strict=True)], part_s
    )


def _solve(
    mass: list[float], link: list[float], out: list[float], right: list[float], part_s: float
) -> list[float]:
    """(mass + part (links + out)) T = right, three diagonals."""
    count = len(mass)
    upper = [0.0] * count
    temps = [0.0] * count
    for i in range(count):
        above = part_s * link[i - 1] if i else 0.0
        below = part_s * link[i] if i + 1 < count else 0.0
        pivot = mass[i] + above + below + part_s * out[i] - (above * upper[i - 1] if i else 0.0)
        upper[i] = below / pivot
        temps[i] = (right[i] + (above * temps[i - 1] if i else 0.0)) / pivot
    for i in range(count - 2, -1, -1):
        temps[i] += upper[i] * temps[i + 1]
    return temps


class DepositMap:
    """The newest layers in every column of a square grid.

    A road is deposited in pieces far shorter than a column; its own fresh material is no substrate. A touch within
    `SAME_PASS_CELLS` of path after the last one belongs to the same pass and meets what the pass met when it came.
    A later road of the same layer has the layer below under it and its neighbour beside it: the contact's
    temperature is their mean, weighted with width and height of the road. A road far below the top of its column shows
    that what stood there has been taken off, as between two prints that come line by line.
    """

    SAME_PASS_CELLS = 1.5  # the diagonal of a cell is 1.41
    SAME_LAYER = 0.5  # of the road's thickness
    NEXT_LAYER = 1.5  # farther down is no layer below
    TAKEN_OFF_MM = 2.0  # more than a bent bed makes of one layer

    def __init__(self, material: Material, surroundings: Surroundings, cell_mm: float = 2.0) -> None:
        self.material = material
        self.surroundings = surroundings
        self.cell_mm = cell_mm
        self._cells: dict[tuple[int, int], Column] = {}

    def __len__(self) -> int:
        return len(self._cells)

    def cool(self, column: Column, time_s: float, fan: float = 0.0) -> None:
        """Bring a column's temperatures to `time_s`."""
        left_s = time_s - column.time_s
        if left_s <= 0.0:
            return
        column.time_s = time_s
        around, thick, cover = self.surroundings, column.thick_mm, column.cover
        around_c, count = around.around_c(column.z_mm), len(column.thick_mm)
        alpha = 1e6 * self.material.diffusivity_m2_s
        h = around.still_w_m2k + fan * around.fan_w_m2k
        loss = 1e3 * h / (self.material.density_kg_m3 * self.material.heat_j_kgk)  # mm/s
        mass = list(thick)
        mass[0] *= cover
        link = [2.0 * alpha / (thick[i] + thick[i + 1]) for i in range(count - 1)]
        out = [loss * column.side_per_mm * mass[i] for i in range(count)]
        out[0] += loss * cover
        if count > 1:
            link[0] *= cover
            out[1] += loss * (1.0 - cover)
        gain = [value * around_c for value in out]
        if sum(thick) >= column.z_mm - self.SAME_LAYER * thick[0]:  # the stack reaches the bed
            out[-1] += 2.0 * alpha / thick[-1]
            gain[-1] += 2.0 * alpha / thick[-1] * around.bed_c
        step_s = FIRST_STEP * thick[0] * thick[0] / alpha
        while left_s > 0.0:
            now_s = left_s if left_s < 1.5 * step_s else step_s
            column.temp_c = _step(mass, link, out, gain, column.temp_c, now_s)
            left_s -= now_s
            step_s *= GROWTH

    def deposit(
        self,
        at_mm: tuple[float, float, float],
        time_s: float,
        melt_c: float,
        thick_mm: float,
        odometer_mm: float,
        width_mm: float = 0.45,
        length_mm: float = 2.0,
        fan: float = 0.0,
    ) -> float:
        """Put a short piece of road down; returns the temperature of what it met."""
        x_mm, y_mm, z_mm = at_mm
        key = math.floor(x_mm / self.cell_mm), math.floor(y_mm / self.cell_mm)
        column = self._cells.get(key)
        if column is None or (column.thick_mm and column.z_mm - z_mm > self.TAKEN_OFF_MM):
            bed_c = self.surroundings.bed_c
            column = self._cells[key] = Column(time_s, z_mm, odometer_mm, bed_c, 0.0)
        same_layer = bool(column.thick_mm) and abs(column.z_mm - z_mm) < self.SAME_LAYER * thick_mm
        passed_mm = odometer_mm - column.odometer_mm
        column.odometer_mm = odometer_mm
        if not same_layer and z_mm - column.z_mm * bool(column.thick_mm) > self.NEXT_LAYER * thick_mm:
            self._adopt(key, column, z_mm, thick_mm)
        if not same_layer or passed_mm > self.SAME_PASS_CELLS * self.cell_mm:
            if column.thick_mm:
                self.cool(column, time_s, fan)
            column.met_c = self._met(column, same_layer, width_mm, thick_mm, z_mm)
        if not same_layer:
            self._begin_layer(column, z_mm, thick_mm, width_mm)
        area_mm2 = max(MIN_MM2, width_mm * length_mm)
        column.area_mm2 += area_mm2
        column.temp_c[0] += area_mm2 / column.area_mm2 * (melt_c - column.temp_c[0])
        return column.met_c

    def _adopt(self, key: tuple[int, int], column: Column, z_mm: float, thick_mm: float) -> None:
        """Nothing lies right below: a leaning wall. Its road lies on the stack of a neighbour."""
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            other = self._cells.get((key[0] + dx, key[1] + dy))
            if other is None or not other.thick_mm:
                continue
            gap_mm = z_mm - other.z_mm
            has_this = abs(gap_mm) < self.SAME_LAYER * thick_mm  # it has this layer already
            if gap_mm > self.NEXT_LAYER * thick_mm or gap_mm <= -self.SAME_LAYER * thick_mm:
                continue
            if len(other.thick_mm) <= has_this:
                continue
            column.time_s, column.side_per_mm = other.time_s, other.side_per_mm
            column.z_mm = other.z_mm - (other.thick_mm[0] if has_this else 0.0)
            column.area_mm2 = other.below_mm2 if has_this else other.area_mm2
            column.below_mm2 = other.below_mm2
            column.thick_mm, column.temp_c = other.thick_mm[has_this:], other.temp_c[has_this:]
            return

    def _met(self, column: Column, same_layer: bool, width_mm: float, thick_mm: float, z_mm: float) -> float:
        temps, bed_c = column.temp_c, self.surroundings.bed_c
        if not temps:
            return bed_c if z_mm <= self.NEXT_LAYER * thick_mm else self.surroundings.around_c(z_mm)
        if not same_layer:
            return temps[0]
        below_c = temps[1] if len(temps) > 1 else bed_c
        return (width_mm * below_c + thick_mm * temps[0]) / (width_mm + thick_mm)

    def _begin_layer(self, column: Column, z_mm: float, thick_mm: float, width_mm: float) -> None:
        """An empty layer on top; the two lowest become one when there is no room."""
        thick, temps = column.thick_mm, column.temp_c
        if thick:
            filled = min(1.0, column.area_mm2 / (self.cell_mm * self.cell_mm))
            column.side_per_mm = 2.0 * (1.0 - filled) / width_mm
        column.below_mm2, column.area_mm2, column.z_mm = column.area_mm2, 0.0, z_mm
        if len(thick) == NODES:
            both_mm = thick[-2] + thick[-1]
            temps[-2:] = [(thick[-2] * temps[-2] + thick[-1] * temps[-1]) / both_mm]
            thick[-2:] = [min(FAR_MM, both_mm)]
        thick.insert(0, thick_mm)
        temps.insert(0, 0.0)
