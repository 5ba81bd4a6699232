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
    "BB": "within the range of nozzle temperature of Bambu Studio's profile for it (github.com/bambulab/BambuStudio,"
    " resources/profiles/BBL/filament/fdm_filament_{pla,pet,abs,pa}.json: 190-250, 220-260, 240-280, 260-300), or, for"
    " PET, its density",
    "ZD": "wiki.zahno.dev/hw/3d-printing/filaments: nozzle temperature of PC 260-310",
    "TT": "github.com/5axes/Calibration-Shapes, wiki, ABS TempTower 250-210: its lowest floor",
    "PM": "Polymaker, PolyTerra PLA technical data sheet V5.3: glass transition 60.6 degC by DSC",
    "WP": "Wikipedia, Polyether ether ketone: thermal conductivity",
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
    origin: tuple[str, ...]

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
        Material("ABS", 0.165, 1800, 1045, 220, 115, 210, 270, (*["S004"] * 4, "CR", "TT", "BB")),
        Material("PLA", 0.13, 1800, 1240, 175.5, 60, 190, 230, (*["S004"] * 4, "PM", "BB", "BB")),
        Material("PETG", 0.20, 1000, 1270, 210, 75, 220, 260, ("PET", "PET", "BB", _U, "PET", "BB", "BB")),
        Material("PA", 0.24, 1700, 1140, 265, 265, 265, 300, ("CR", "CR", "CR", "CA", "CA", "BB", "BB")),
        Material("PC", 0.20, 1200, 1150, 265, 150, 260, 310, ("CR", "CR", "CR", "CA", "CA", "ZD", "ZD")),
        Material("PEI", 0.22, 1500, 1270, 320, 200, 340, 390, ("CR", _U, "CR", _U, "CR", _U, _U)),
        Material("PEEK", 0.25, 1500, 1300, 334, 334, 360, 430, ("WP", _U, "CR", "CA", "CA", _U, _U)),
        Material("HDPE", 0.25, 2200, 950, 137, 135, 190, 260, ("CR", "CR", "CR", "CA", "S002", _U, _U)),
    )
}
