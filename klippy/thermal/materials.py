"""Filament materials. Every number names its source; a number without a citation is marked UNVERIFIED.

Properties of polymers scatter by 20 % and more between grades and rise with temperature: the table is a start
for a filament whose data sheet is not at hand, not a substitute for it.
"""

from __future__ import annotations

from dataclasses import dataclass

from .weld import effusivity

SOURCES = {
    "S004": "source 004 (Horoshailo et al. 2019), table 1; middle of a printed range",
    "S002": "source 002 (HydraRaptor 2007)",
    "CR": "R. J. Crawford, Plastics Engineering, table 1.8 (typical thermal properties of materials)",
    "CA": "W. D. Callister, Materials Science and Engineering, appendix E (Tg and Tm of common polymers)",
    "PET": "value of PET (Crawford, table 1.8), the unmodified polymer",
    "UNVERIFIED": "usual practice, no citation found; replace it by the filament's data sheet",
}


@dataclass(frozen=True, slots=True)
class Material:
    """k W/mK, cp J/kgK, rho kg/m3; temperatures degC. `origin`: one key of SOURCES for each number, in order."""

    name: str
    conductivity_w_mk: float
    heat_j_kgk: float
    density_kg_m3: float
    flow_c: float  # the core must reach it to be laid: melting, or softening of amorphous ones
    bonding_c: float  # chains cross the weld above it: Tg of amorphous ones and PLA, melting of the others
    low_c: float  # window of melt temperature
    high_c: float
    origin: tuple[str, str, str, str, str, str, str]

    @property
    def diffusivity_m2_s(self) -> float:
        return self.conductivity_w_mk / (self.heat_j_kgk * self.density_kg_m3)

    @property
    def effusivity(self) -> float:
        return effusivity(self.conductivity_w_mk, self.density_kg_m3, self.heat_j_kgk)


_U = "UNVERIFIED"
MATERIALS = {
    material.name: material
    for material in (
        Material(
            "ABS", 0.165, 1800, 1045, 220, 115, 210, 270, ("S004", "S004", "S004", "S004", "CR", _U, _U)
        ),
        Material("PLA", 0.13, 1800, 1240, 175.5, 60, 180, 230, ("S004", "S004", "S004", "S004", _U, _U, _U)),
        Material("PETG", 0.20, 1000, 1270, 210, 75, 215, 265, ("PET", "PET", _U, _U, "PET", _U, _U)),
        Material("PA", 0.24, 1700, 1140, 265, 265, 265, 300, ("CR", "CR", "CR", "CA", "CA", _U, _U)),
        Material("PC", 0.20, 1200, 1150, 265, 150, 260, 310, ("CR", "CR", "CR", "CA", "CA", _U, _U)),
        Material("PEI", 0.22, 1500, 1270, 320, 200, 340, 390, ("CR", _U, "CR", _U, "CR", _U, _U)),
        Material("PEEK", 0.25, 1500, 1300, 334, 334, 360, 430, (_U, _U, "CR", "CA", "CA", _U, _U)),
        Material("HDPE", 0.25, 2200, 950, 137, 135, 190, 260, ("CR", "CR", "CR", "CA", "S002", _U, _U)),
    )
}
