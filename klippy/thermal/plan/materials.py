"""Filament materials. Every number names its source.

Properties of polymers scatter by 20 % and more between grades and rise with temperature: the table is a start
for a filament whose data sheet is not at hand, not a substitute for it. The diffusivity of ABS alone: Horoshailo 2019
gives 0.53 to 1.5e-7 m2/s, Crawford's row 1.85e-7.

Where chains cross a weld: amorphous polymers interdiffuse above the glass transition (Seppala et al., Soft Matter 13,
2017, doi 10.1039/C7SM00950J), semi-crystalline ones above melting until crystals stop it (Adhikari et al.,
Macromolecules 2022, doi 10.1021/acs.macromol.1c02612, on PEEK). Printed PLA stays below 3 % crystallinity (Liparoti
et al., Polymers 13, 2021, 399, doi 10.3390/polym13030399) and counts as amorphous.
"""

from __future__ import annotations

from dataclasses import dataclass

SOURCES = {
    "HO": "Horoshailo 2019, table 1; middle of a printed range",
    "HY": "HydraRaptor 2007",
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
    "AU": "Autodesk Moldflow, PETG materials (help.autodesk.com, MFLO_PETG_MATERIALS): melt 220-290 degC; the lowest",
    "FD": "github.com/hyiger/filament-db, wiki, FDM Appendices, table A.1: glass transition of PETG 75-80 degC; the"
    " upper (Autodesk Moldflow: 88)",
    "MW": "MatWeb, unreinforced PEI, as in RCAIDE/Library/Attributes/Solids/Polyetherimide.py (RCAIDE_LEADS)",
    "NZ": "NETZSCH, identification of polymers, PEI: glass transition 217 degC by DSC, second heating",
    "LO": "Loh, Sotayo, Pei, Fashion and Textiles 8 (2021), doi 10.1186/s40691-020-00232-7, table 2: nozzle 355-390"
    " degC; the core has to reach the lower",
    "MF": "makeitfrom.com, Polyetheretherketone: specific heat 1390-1700 J/kgK; the middle",
    "VX": "proquest.com/docview/2548735480 (2021), introduction: PEEK melts at 343 degC (Callister has 334)",
    "KI": "3D PEEK objects by FFF, Materials 15 (2022) 898, doi 10.3390/ma15030898: printed from 360 degC on",
    "TG": "github.com/TigerTag-Project/TigerTag-RFID-Guide, database/id_material.json: nozzle of PEEK 390-410, of PE"
    " 175-220 degC",
    "UN": "Rijekki et al., journal.uny.ac.id/index.php/jeatech/article/view/76071: HDPE extruded at 160-240 degC",
}


@dataclass(frozen=True, slots=True)
class Material:
    """k W/mK, cp J/kgK, rho kg/m3; temperatures degC. `origin`: one key of SOURCES for each number, in order."""

    name: str
    conductivity_w_mk: float
    heat_j_kgk: float
    density_kg_m3: float
    flow_c: float  # the core must reach it to be deposited: melting, or softening of amorphous ones
    bonding_c: float  # chains cross the weld above it: Tg of amorphous ones and PLA, melting of the others
    low_c: float  # window of melt temperature
    high_c: float
    origin: tuple[str, ...]

    @property
    def diffusivity_m2_s(self) -> float:
        return self.conductivity_w_mk / (self.heat_j_kgk * self.density_kg_m3)


MATERIALS = {
    material.name: material
    for material in (
        Material("ABS", 0.165, 1800, 1045, 220, 115, 210, 270, (*["HO"] * 4, "CR", "TT", "BB")),
        Material("PLA", 0.13, 1800, 1240, 175.5, 60, 190, 230, (*["HO"] * 4, "PM", "BB", "BB")),
        Material("PETG", 0.20, 1000, 1270, 220, 80, 220, 260, ("PET", "PET", "BB", "AU", "FD", "BB", "BB")),
        Material("PA", 0.24, 1700, 1140, 265, 265, 265, 300, ("CR", "CR", "CR", "CA", "CA", "BB", "BB")),
        Material("PC", 0.20, 1200, 1150, 265, 150, 260, 310, ("CR", "CR", "CR", "CA", "CA", "ZD", "ZD")),
        Material("PEI", 0.22, 1100, 1270, 355, 217, 355, 390, ("CR", "MW", "CR", "LO", "NZ", "LO", "LO")),
        Material("PEEK", 0.25, 1550, 1300, 343, 343, 360, 410, ("WP", "MF", "CR", "VX", "VX", "KI", "TG")),
        Material("HDPE", 0.25, 2200, 950, 137, 135, 175, 240, ("CR", "CR", "CR", "CA", "HY", "TG", "UN")),
    )
}
