"""Sections of Klipper's configuration reference that this program has no module for.

A printer prints without some of them: these are left out, and one notice lists what does not work. The others do
something the printer relies on (pins, levelling, a motor's current): a config that has them is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from configtext import ConfigError, SectionText


@dataclass(frozen=True, slots=True)
class Dispensable:
    """Kinds of section that belong together, and what a printer lacks without them."""

    kinds: frozenset[str]
    consequence: str


DISPENSABLE = (
    Dispensable(
        frozenset({"display", "display_data", "display_glyph", "menu"}),
        "the display stays dark, its knob and buttons do nothing",
    ),
)

# What a section brings that macros use, although the section itself does nothing here: kind -> module
BROUGHT_ALONG = {"display": "display_status"}

REFUSED = frozenset({
    "angle", "axis_twist_compensation", "bed_tilt", "delta_calibrate", "hall_filament_width_sensor", "load_cell",
    "load_cell_probe", "palette2", "probe_eddy_current", "replicape", "smart_effector", "sx1509",
    "temperature_probe", "tsl1401cl_filament_width_sensor", "z_thermal_adjust",
})  # fmt: skip


def kind_of(section: str) -> str:
    """The word that says which module a section is for."""
    return section.split(maxsplit=1)[0]


def find_left_out(
    sections: Mapping[str, SectionText], has_module: Callable[[str], bool]
) -> dict[str, SectionText]:
    """Sections the printer does without. Raises ConfigError if there are others of Klipper's without a module.

    `has_module` says whether there is a module for a kind of section: a plugin may bring what is missing here.
    """
    missing = {name: section for name, section in sections.items() if not has_module(kind_of(name))}
    refused = [section for name, section in missing.items() if kind_of(name) in REFUSED]
    if refused:
        lines = [f"Klipper has [{s.name}], Ferrite does not yet ({s.origin})." for s in refused]
        what, it = ("this section", "it") if len(refused) == 1 else ("these sections", "them")
        raise ConfigError("\n".join([*lines, f"Take {what} out of the config, and what refers to {it}."]))
    dispensable = frozenset().union(*(group.kinds for group in DISPENSABLE))
    return {name: section for name, section in missing.items() if kind_of(name) in dispensable}


def notice(left_out: Iterable[SectionText]) -> str:
    """The notice about sections that are left out: one line for each thing that does not work."""
    lines = ["Klipper has these sections, Ferrite does not yet. The printer works without them:"]
    found = list(left_out)
    for group in DISPENSABLE:
        origins: dict[str, str] = {}
        for section in found:
            if kind_of(section.name) in group.kinds:
                origins.setdefault(kind_of(section.name), f"[{kind_of(section.name)}] ({section.origin})")
        if origins:
            lines.append(f"{', '.join(origins.values())}: {group.consequence}.")
    return "\n".join(lines)
