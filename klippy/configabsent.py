"""Sections of Klipper's configuration reference that this program has no module for.

They are left out, the printer starts, and one notice lists what does not work. Pins of such a section can be named
elsewhere in the config (absentpins.py): outputs do nothing, and homing with such an endstop fails with a clear message.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

from configtext import SectionText


@dataclass(frozen=True, slots=True)
class Dispensable:
    """Kinds of section that belong together, and what a printer lacks without them."""

    kinds: frozenset[str]
    consequence: str


DISPENSABLE = (
    Dispensable(
        frozenset({"load_cell_probe", "probe_eddy_current"}),
        "there is no probe: homing by it fails, levelling works by hand with METHOD=manual",
    ),
    Dispensable(frozenset({"angle", "load_cell"}), "the sensor is not read"),
    Dispensable(frozenset({"palette2"}), "the Palette is not driven: print with one filament only"),
)

# Sections that another one reads, wherever they stand: kind of section -> the section without which they mean nothing
READ_BY = {"display_data": "display", "display_glyph": "display", "menu": "display"}

# Chips whose pins other sections may name: kind of section -> name of the chip; None: as the section, with "_"
PIN_CHIPS: dict[str, str | None] = {
    "load_cell_probe": "probe",
    "probe_eddy_current": "probe",
}


_READ_LAST = re.compile(
    r"mcu|printer|stepper(_\w+)?|extruder\d*|carriage|extra_carriage|dual_carriage", re.IGNORECASE
)


def kind_of(section: str) -> str:
    """The word that says which module a section is for."""
    return section.split(maxsplit=1)[0]


def is_read_last(section: str) -> bool:
    """Whether boards or the toolhead read a section, rather than a module of its name."""
    return _READ_LAST.fullmatch(kind_of(section)) is not None


def find_left_out(
    sections: Mapping[str, SectionText], has_module: Callable[[str], bool]
) -> dict[str, SectionText]:
    """Sections the printer does without.

    `has_module` says whether there is a module for a kind of section: a plugin may bring what is missing here.
    """
    kinds = frozenset().union(*(group.kinds for group in DISPENSABLE))
    return {
        name: section
        for name, section in sections.items()
        if kind_of(name) in kinds and not has_module(kind_of(name))
    }


def pin_chips(left_out: Iterable[str]) -> Iterator[tuple[str, str]]:
    """(chip, section) for sections left out that others may name pins of."""
    for name in left_out:
        if kind_of(name) in PIN_CHIPS:
            yield PIN_CHIPS[kind_of(name)] or "_".join(name.split()), name


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
