"""[display_template NAME]: a template with parameters that other modules evaluate again and again (LEDs).

text: {% if printer.extruder.target %}1, 0, 0, 0{% else %}{param_idle}{% endif %}
param_idle: "0, 0, 1, 0"
"""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .gcode_macro import parse_literal

PREFIX = "param_"


class DisplayTemplate:
    """The object `display_template NAME`; its status are its parameters' defaults."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name().split(maxsplit=1)[-1]
        self.parameters: dict[str, Any] = {}
        for option in config.get_prefix_options(PREFIX):
            try:
                self.parameters[option] = parse_literal(config.get(option))
            except ValueError as e:
                raise config.error(
                    f"Option '{option}' in section '{config.get_name()}' is not a literal: {e}"
                ) from None
        self._template = self.printer.load_object(config, "gcode_macro").load_template(config, "text")

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """The parameters as configured."""
        return self.parameters

    def render(self, context: dict[str, Any], parameters: dict[str, Any]) -> str:
        """The text, on one line, with some parameters replaced. Raises a command error."""
        names = {**context, **self.parameters, **parameters}
        return "".join(self._template.render(names).split("\n"))


def parse_parameters(gcmd: GCodeCommand, template: DisplayTemplate) -> dict[str, Any]:
    """The PARAM_x=literal of a command that assigns a template. Raises a command error."""
    parameters: dict[str, Any] = {}
    for key, text in gcmd.get_command_parameters().items():
        name = key.lower()
        if not name.startswith(PREFIX):
            continue
        if name not in template.parameters:
            raise gcmd.error(f"Template '{template.name}' has no parameter {name}")
        try:
            parameters[name] = parse_literal(text)
        except ValueError as e:
            raise gcmd.error(f"Unable to parse '{text}' as a literal: {e}") from None
    return parameters


def load_config_prefix(config: ConfigWrapper) -> DisplayTemplate:
    """Section [display_template NAME]."""
    return DisplayTemplate(config)
