"""Option names and values of earlier versions: accepted with a warning, and replaced by those of today."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from configtext import OptionText, SectionText

OPTIONS = {"practical_turn": "two_period_turn", "practical_cutoff": "two_period_cutoff"}
VALUES = {("control", "practical"): "two_period"}


def replace_old(sections: Mapping[str, SectionText]) -> Iterator[dict[str, Any]]:
    """Replace them in place; a warning for each. An option written under today's name, too, keeps that value."""
    for name, section in sections.items():
        for key, option in list(section.options.items()):
            value = option.value.strip()
            if new := OPTIONS.get(key):
                section.options.setdefault(new, section.options.pop(key))
                message = f"Option '{key}' in section '{name}' is now called '{new}' ({option.origin})."
                yield {"type": "deprecated_option", "message": message, "section": name, "option": key}
            elif new := VALUES.get((key, value)):
                section.options[key] = OptionText(new, option.origin)
                message = (
                    f"Value '{value}' of option '{key}' in section '{name}' is now '{new}' ({option.origin})."
                )
                warning = {"type": "deprecated_value", "message": message, "section": name, "option": key}
                yield {**warning, "value": value}
