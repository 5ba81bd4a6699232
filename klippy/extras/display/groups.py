"""[display_data GROUP NAME]: what is on a screen, a text at a place; the texts are templates.

In them `render(name, param_x=...)` gives a [display_template]; `draw_progress_bar(row, col, width, value)` draws.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper

from ..display_template import DisplayTemplate
from .panel import Glyph, Panel, put_line

PREFIX = "display_data "
TEMPLATE_PREFIX = "display_template "


@dataclass(frozen=True, slots=True)
class Item:
    """One text of a group."""

    row: int
    column: int
    template: Any


def read_groups(config: ConfigWrapper, defaults: ConfigWrapper) -> dict[str, list[Item]]:
    """Groups by name. A section of the config replaces the default one of the same name."""
    templates = config.get_printer().load_object(config, "gcode_macro")
    groups: dict[str, list[Item]] = {}
    own = config.get_prefix_sections(PREFIX)
    replaced = {section.get_name() for section in own}
    kept = [s for s in defaults.get_prefix_sections(PREFIX) if s.get_name() not in replaced]
    for section in [*kept, *own]:
        words = section.get_name().split()
        if len(words) != 3:
            raise config.error(
                f"Section '{section.get_name()}' must be named after a group and an item, such as"
                f" 'display_data my_group my_item' ({section.where()})."
            )
        row, column = section.getintlist("position", count=2)
        if row < 0 or column < 0:
            raise config.error(
                f"Option 'position' in section '{section.get_name()}' must be a row and a column from 0 on"
                f" ({section.where('position')})."
            )
        item = Item(row, column, templates.load_template(section, "text"))
        groups.setdefault(words[1], []).append(item)
    return groups


def read_templates(defaults: ConfigWrapper) -> dict[str, DisplayTemplate]:
    """The templates that come with the default groups."""
    sections = defaults.get_prefix_sections(TEMPLATE_PREFIX)
    return {s.get_name().removeprefix(TEMPLATE_PREFIX): DisplayTemplate(s) for s in sections}


class Renderer:
    """Draws a group on a panel, one item a step."""

    def __init__(
        self, printer: Any, panel: Panel, glyphs: Mapping[str, Glyph], defaults: Mapping[str, DisplayTemplate]
    ) -> None:
        self.printer, self._panel, self._glyphs, self._defaults = printer, panel, glyphs, defaults
        self._failed: set[int] = set()

    def context(self, eventtime: float) -> dict[str, Any]:
        """Names that the texts may use."""
        context: dict[str, Any] = self.printer.lookup_object("gcode_macro").create_template_context(eventtime)
        context["draw_progress_bar"] = self._draw_progress_bar

        def render(name: str, **parameters: Any) -> str:
            template = self.printer.lookup_object(f"{TEMPLATE_PREFIX}{name}", None) or self._defaults.get(
                name
            )
            if template is None:
                raise self.printer.command_error(f"There is no [display_template {name}].")
            return str(template.render(context, parameters))

        context["render"] = render
        return context

    def draw(self, items: list[Item], eventtime: float) -> Iterator[float]:
        """Put all items on the panel."""
        context = self.context(eventtime)
        for item in items:
            put_line(self._panel, self._glyphs, item.row, item.column, self._render(item, context))
            yield 0.0

    def _render(self, item: Item, context: dict[str, Any]) -> str:
        """The text; empty for a template that fails, which is logged once."""
        try:
            text: str = item.template.render(context)
        except self.printer.command_error as e:
            if id(item) not in self._failed:
                self._failed.add(id(item))
                logging.warning("display: %s", e)
            return ""
        return text.replace("\n", "")

    def _draw_progress_bar(self, row: int, col: int, width: int, value: float) -> str:
        self._panel.put_bar(int(row), int(col), int(width), float(value))
        return ""
