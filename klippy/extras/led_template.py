"""SET_LED_TEMPLATE: LEDs that follow the printer's status. One timer evaluates the templates of all LEDs."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from .display_template import DisplayTemplate, parse_parameters

if TYPE_CHECKING:
    from .led import LEDHelper

PERIOD_S = 0.5
COLOR_COUNT = 4


@dataclass(slots=True)
class _Assignment:
    """What one LED of a chain shows."""

    template: DisplayTemplate
    parameters: dict[str, Any] = field(default_factory=dict)


class LEDTemplates:
    """The templates of one printer's LEDs: chain → number of the LED from 1 on → template."""

    def __init__(self, printer: Any) -> None:
        self.printer = printer
        self.reactor = printer.get_reactor()
        self._assigned: dict[LEDHelper, dict[int, _Assignment]] = {}
        self._timer: Any = None

    def assign(self, leds: LEDHelper, gcmd: Any) -> None:
        """SET_LED_TEMPLATE LED=name TEMPLATE=name [PARAM_x=literal] [INDEX=n]; an empty TEMPLATE ends it."""
        index = gcmd.get_int("INDEX", None, minval=1, maxval=leds.get_led_count())
        numbers = range(1, leds.get_led_count() + 1) if index is None else (index,)
        name = gcmd.get("TEMPLATE")
        chain = self._assigned.setdefault(leds, {})
        if not name:
            for number in numbers:
                chain.pop(number, None)
            return
        template = self.printer.lookup_object(f"display_template {name}", None)
        if template is None:
            raise gcmd.error(f"Unknown display_template '{name}'")
        parameters = parse_parameters(gcmd, template)
        for number in numbers:
            chain[number] = _Assignment(template, parameters)
        if self._timer is None:
            self._timer = self.reactor.register_timer(self._update, self.reactor.NOW)

    def _update(self, eventtime: float) -> float:
        self._assigned = {leds: chain for leds, chain in self._assigned.items() if chain}
        if not self._assigned:
            self.reactor.unregister_timer(self._timer)
            self._timer = None
            return float(self.reactor.NEVER)
        context = self.printer.lookup_object("gcode_macro").create_template_context(eventtime)
        rendered: dict[str, tuple[float, ...]] = {}
        for leds, chain in self._assigned.items():
            for number, assignment in chain.items():
                key = f"{assignment.template.name} {assignment.parameters}"
                if key not in rendered:
                    rendered[key] = self._color(assignment, context)
                color = rendered[key]
                leds.set_color(number, (color[0], color[1], color[2], color[3]))
            leds.check_transmit(None)
        return eventtime + PERIOD_S

    def _color(self, assignment: _Assignment, context: dict[str, Any]) -> tuple[float, ...]:
        """Four figures between 0 and 1; black for a template that does not give any."""
        try:
            text = assignment.template.render(context, assignment.parameters)
            parts = [float(part) for part in text.split(",")]
        except (ValueError, self.printer.command_error) as e:
            logging.info("LED template '%s': %s", assignment.template.name, e)
            parts = []
        parts = [*parts[:COLOR_COUNT], *[0.0] * (COLOR_COUNT - len(parts))]
        return tuple(min(1.0, max(0.0, part)) for part in parts)


def load_config(config: Any) -> LEDTemplates:
    """Loaded by LED modules."""
    config.get_printer().load_object(config, "gcode_macro")
    return LEDTemplates(config.get_printer())
