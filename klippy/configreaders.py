"""Which sections of a config are not for a module of their name."""

from __future__ import annotations

import re

# Sections that another one reads, wherever they stand: kind of section -> the section without which they mean nothing
READ_BY = {"display_data": "display", "display_glyph": "display", "menu": "display"}

_READ_LAST = re.compile(
    r"mcu|printer|stepper(_\w+)?|extruder\d*|carriage|extra_carriage|dual_carriage", re.IGNORECASE
)


def kind_of(section: str) -> str:
    """The word that says which module a section is for."""
    return section.split(maxsplit=1)[0]


def is_read_last(section: str) -> bool:
    """Whether boards or the toolhead read a section, rather than a module of its name."""
    return _READ_LAST.fullmatch(kind_of(section)) is not None
