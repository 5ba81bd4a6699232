"""Where and when material was laid, and how warm it still is when the next road touches it.

Cooling law of a road of thickness d on what lies below (equal medium), its free side nearly insulated; exact
solution of the slab on a half space, at the free side, times a slow loss to the surroundings:

    T(t) = Te + [(Tb - Te) + (T0 - Tb) erf(d / (2 sqrt(alpha t)))] exp(-t h / (rho c d))

T0 laid, Tb the base at that moment, Te the surroundings (bed near the bed, chamber above). The weld, at depth
d, is at Te + [(Tb - Te) + (T0 - Tb)/2 erf(d / sqrt(alpha t))] exp(..): it starts at the mean of T0 and Tb.

Against infrared measurements of ABS (Seppala & Migler 2016, doi 10.1016/j.addma.2016.06.007: above Tg for
about 1 s, falling about 100 K/s) the time above Tg agrees in order; the rate at the weld is about a quarter of
the measured one, so the law keeps welds warm too long right after laying.

The map is a grid of columns that keeps the newest road only: memory goes with the area of the part, not with
the number of moves.
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


Laid = tuple[float, float, float, float, float]  # time s, z mm, laid degC, base degC, thickness mm


class DepositMap:
    """The newest road in every column of a square grid."""

    def __init__(self, material: Material, surroundings: Surroundings, cell_mm: float = 2.0) -> None:
        self.material = material
        self.surroundings = surroundings
        self.cell_mm = cell_mm
        self._cells: dict[tuple[int, int], Laid] = {}

    def __len__(self) -> int:
        return len(self._cells)

    def _cell(self, x_mm: float, y_mm: float) -> tuple[int, int]:
        return math.floor(x_mm / self.cell_mm), math.floor(y_mm / self.cell_mm)

    def substrate_c(self, x_mm: float, y_mm: float, time_s: float, fan: float = 0.0) -> float:
        """What a road laid here and now meets: the newest road of the column, else the bed."""
        laid = self._cells.get(self._cell(x_mm, y_mm))
        around = self.surroundings
        if laid is None:
            return around.bed_c
        then_s, z_mm, laid_c, base_c, thick_mm = laid
        h = around.still_w_m2k + fan * around.fan_w_m2k
        around_c = around.around_c(z_mm)
        return surface_c(self.material, laid_c, base_c, around_c, h, thick_mm, time_s - then_s)

    def lay(
        self,
        x_mm: float,
        y_mm: float,
        z_mm: float,
        time_s: float,
        melt_c: float,
        thick_mm: float,
        fan: float = 0.0,
    ) -> float:
        """Put a road down; returns the temperature of the substrate it met.

        A second road of the same layer in the column finds its neighbour; the column's base stays the one of
        the first, since the neighbour does not lie below.
        """
        met_c = self.substrate_c(x_mm, y_mm, time_s, fan)
        key = self._cell(x_mm, y_mm)
        before = self._cells.get(key)
        same_layer = before is not None and abs(before[1] - z_mm) < 0.5 * thick_mm
        base_c = before[3] if before is not None and same_layer else met_c
        self._cells[key] = (time_s, z_mm, melt_c, base_c, thick_mm)
        return met_c
