"""Outputs that follow the printer's status: a `[display_template]` assigned to an LED, a pin or a fan.

One timer renders all assigned templates, each with the same parameters once, and hands the texts to their outputs.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

from .display_template import DisplayTemplate, parse_parameters

PERIOD_S = 0.5


@dataclass(frozen=True, slots=True)
class _Assignment:
    """What one output shows; `after` is called once when all outputs that share it have their text."""

    template: DisplayTemplate
    parameters: dict[str, Any]
    show: Callable[[str], None]
    after: Callable[[], None] | None


class TemplateEvaluator:
    """The object `template_evaluator`."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.reactor = printer.get_reactor()
        self._assigned: dict[Hashable, _Assignment] = {}
        self._timer: Any = None

    def assign(
        self,
        output: Hashable,
        gcmd: GCodeCommand,
        show: Callable[[str], None],
        after: Callable[[], None] | None = None,
    ) -> None:
        """TEMPLATE=name [PARAM_x=literal] of a command: call show(text) from now on. An empty name ends it.

        `show` may raise ValueError for a text that is no value. Raises a command error.
        """
        name = gcmd.get("TEMPLATE")
        if not name:
            self.forget(output)
            return
        template = self.printer.lookup_object(f"display_template {name}", None)
        if template is None:
            raise gcmd.error(f"Unknown display_template '{name}'")
        self._assigned[output] = _Assignment(template, parse_parameters(gcmd, template), show, after)
        if self._timer is None:
            self._timer = self.reactor.register_timer(self._update, self.reactor.NOW)

    def forget(self, output: Hashable) -> None:
        """The output is set by hand again."""
        self._assigned.pop(output, None)

    def _update(self, eventtime: float) -> float:
        if not self._assigned:
            self.reactor.unregister_timer(self._timer)
            self._timer = None
            return float(self.reactor.NEVER)
        context = self.printer.lookup_object("gcode_macro").create_template_context(eventtime)
        rendered: dict[str, str] = {}
        for assignment in list(self._assigned.values()):
            key = f"{assignment.template.name} {assignment.parameters}"
            if key not in rendered:
                rendered[key] = self._render(assignment, context)
            self._show(assignment, rendered[key])
        for after in dict.fromkeys(assignment.after for assignment in self._assigned.values()):
            if after is not None:
                after()
        return eventtime + PERIOD_S

    def _render(self, assignment: _Assignment, context: dict[str, Any]) -> str:
        """The text; empty for a template that fails."""
        try:
            return assignment.template.render(context, assignment.parameters)
        except self.printer.command_error as e:
            logging.info("%s", e)
            return ""

    @staticmethod
    def _show(assignment: _Assignment, text: str) -> None:
        try:
            assignment.show(text)
        except ValueError:
            logging.info("Template '%s' gives '%s', which is no value", assignment.template.name, text)
            assignment.show("0")


def load_config(config: ConfigWrapper) -> TemplateEvaluator:
    """Loaded by modules with outputs."""
    config.get_printer().load_object(config, "gcode_macro")
    return TemplateEvaluator(config.get_printer())
