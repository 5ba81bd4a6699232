"""Where and when material was laid, and how warm it still is when the next road touches it.

Cooling law of a road of thickness d on what lies below (equal medium), its free side nearly insulated; exact
solution of the slab on a half space, at the free side, times a slow loss to the surroundings:

    T(t) = Te + [(Tb - Te) + (T0 - Tb) erf(d / (2 sqrt(alpha t)))] exp(-t h / (rho c d))

T0 laid, Tb the base at that moment, Te the surroundings (bed near the bed, chamber above). The weld, at depth
d, is at Te + [(Tb - Te) + (T0 - Tb)/2 erf(d / sqrt(alpha t))] exp(..): it starts at the mean of T0 and Tb.

Against infrared measurements of ABS (Seppala & Migler 2016, doi 10.1016/j.addma.2016.06.007: above Tg for
about 1 s, falling about 100 K/s) the time above Tg agrees in order; the rate at the weld is about a quarter of
the measured one, so the law keeps welds warm too long right after laying.

The map is a grid of columns that keeps two roads each: memory goes with the area of the part, not with the
number of moves. `DepositMap` is the readable form; a print runs chelper/tempplan.c, which the tests hold to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from .materials import Material


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Boundary of the part. h: 30 W/m2K still air with radiation, up to 90 with the fan (typical, settable)."""

    bed_c: float = 60.0
    chamber_c: float = 25.0
    still_w_m2k: float = 30.0
    fan_w_m2k: float = 60.0  # added at full fan
    bed_reach_mm: float = 3.0  # height over which the bed's influence falls to 1/e

    def around_c(self, z_mm: float) -> float:
        return self.chamber_c + (self.bed_c - self.chamber_c) * math.exp(-max(0.0, z_mm) / self.bed_reach_mm)


def surface_c(
    material: Material,
    laid_c: float,
    base_c: float,
    around_c: float,
    h_w_m2k: float,
    thick_mm: float,
    age_s: float,
) -> float:
    """Temperature of a road's upper side `age_s` after it was laid."""
    if age_s <= 0.0:
        return laid_c
    reach_mm = 2e3 * math.sqrt(material.diffusivity_m2_s * age_s)
    kept = math.exp(-age_s * h_w_m2k / (material.density_kg_m3 * material.heat_j_kgk * thick_mm * 1e-3))
    return around_c + (base_c - around_c + (laid_c - base_c) * math.erf(thick_mm / reach_mm)) * kept


def weld_c(
    material: Material,
    laid_c: float,
    base_c: float,
    around_c: float,
    h_w_m2k: float,
    thick_mm: float,
    age_s: float,
) -> float:
    """Temperature of the weld under a road; at age 0 the mean of road and base."""
    if age_s <= 0.0:
        return 0.5 * (laid_c + base_c)
    reach_mm = 1e3 * math.sqrt(material.diffusivity_m2_s * age_s)
    kept = math.exp(-age_s * h_w_m2k / (material.density_kg_m3 * material.heat_j_kgk * thick_mm * 1e-3))
    return around_c + (base_c - around_c + 0.5 * (laid_c - base_c) * math.erf(thick_mm / reach_mm)) * kept


@dataclass(frozen=True, slots=True)
class Road:
    """Laid at `time_s` and `laid_c` on something at `base_c`."""

    time_s: float
    z_mm: float
    laid_c: float
    base_c: float
    thick_mm: float


@dataclass(slots=True)
class Column:
    """The newest road of the newest layer, that of the layer below, and what the present pass met."""

    top: Road
    under: Road | None
    met_c: float
    odometer_mm: float  # path of the head when it was last here


class DepositMap:
    """The newest roads in every column of a square grid.

    A road is laid in pieces far shorter than a column; its own fresh material is no substrate. A touch within
    `SAME_PASS_CELLS` of path after the last one belongs to the same pass and meets what the pass met when it came.
    A later road of the same layer has the layer below under it and its neighbour beside it: the contact's
    temperature is their mean, weighted with width and height of the road.
    """

    SAME_PASS_CELLS = 1.5  # the diagonal of a cell is 1.41
    SAME_LAYER = 0.5  # of the road's thickness

    def __init__(self, material: Material, surroundings: Surroundings, cell_mm: float = 2.0) -> None:
        self.material = material
        self.surroundings = surroundings
        self.cell_mm = cell_mm
        self._cells: dict[tuple[int, int], Column] = {}

    def __len__(self) -> int:
        return len(self._cells)

    def road_c(self, road: Road | None, time_s: float, fan: float = 0.0) -> float:
        """Upper side of a road now; without a road that is the bed."""
        around = self.surroundings
        if road is None:
            return around.bed_c
        h = around.still_w_m2k + fan * around.fan_w_m2k
        around_c = around.around_c(road.z_mm)
        age_s = time_s - road.time_s
        return surface_c(self.material, road.laid_c, road.base_c, around_c, h, road.thick_mm, age_s)

    def lay(
        self,
        at_mm: tuple[float, float, float],
        time_s: float,
        melt_c: float,
        thick_mm: float,
        odometer_mm: float,
        width_mm: float = 0.45,
        fan: float = 0.0,
    ) -> float:
        """Put a short piece of road down; returns the temperature of what it met."""
        x_mm, y_mm, z_mm = at_mm
        key = math.floor(x_mm / self.cell_mm), math.floor(y_mm / self.cell_mm)
        column = self._cells.get(key)
        if column is None:
            met_c = self.surroundings.bed_c
            self._cells[key] = Column(Road(time_s, z_mm, melt_c, met_c, thick_mm), None, met_c, odometer_mm)
            return met_c
        same_layer = abs(column.top.z_mm - z_mm) < self.SAME_LAYER * thick_mm
        passed_mm = odometer_mm - column.odometer_mm
        column.odometer_mm = odometer_mm
        if same_layer and passed_mm <= self.SAME_PASS_CELLS * self.cell_mm:
            return column.met_c
        top_c = self.road_c(column.top, time_s, fan)
        if same_layer:
            below_c = self.road_c(column.under, time_s, fan)
            column.met_c = (width_mm * below_c + thick_mm * top_c) / (width_mm + thick_mm)
            base_c = column.top.base_c
        else:
            column.met_c = base_c = top_c
            column.under = column.top
        column.top = Road(time_s, z_mm, melt_c, base_c, thick_mm)
        return column.met_c
