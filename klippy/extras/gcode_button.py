"""[gcode_button NAME]: G-code when a button is pressed or released; QUERY_BUTTON."""

from __future__ import annotations

import logging
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .buttons import debounced


class GCodeButton:
    """The object `gcode_button NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name().split()[-1]
        self.last_state = 0
        self._gcode = self.printer.lookup_object("gcode")
        templates = self.printer.load_object(config, "gcode_macro")
        self._press = templates.load_template(config, "press_gcode")
        self._release = templates.load_template(config, "release_gcode", "")
        buttons = self.printer.load_object(config, "buttons")
        on_button = debounced(config, self._on_button)
        pin = config.get("pin")
        analog_range = config.getfloatlist("analog_range", None, count=2)
        if analog_range is None:
            buttons.register_buttons([pin], on_button)
        else:
            pullup_ohm = config.getfloat("analog_pullup_resistor", 4700.0, above=0.0)
            buttons.register_adc_button(pin, *sorted(analog_range), pullup_ohm, on_button)

    def register(self) -> None:
        """Make the command known."""
        self._gcode.register_mux_command(
            "QUERY_BUTTON", "BUTTON", self.name, self.cmd_QUERY_BUTTON, desc="Report on the state of a button"
        )

    def get_status(self, eventtime: float) -> dict[str, str]:
        return {"state": "PRESSED" if self.last_state else "RELEASED"}

    def cmd_QUERY_BUTTON(self, gcmd: GCodeCommand) -> None:
        """The button's state."""
        gcmd.respond_info(f"{self.name}: {self.get_status(0.0)['state']}")

    def _on_button(self, eventtime: float, state: int) -> None:
        self.last_state = state
        template = self._press if state else self._release
        self.printer.get_reactor().register_callback(lambda when: self._run(template))

    def _run(self, template: Any) -> None:
        try:
            self._gcode.run_script(template.render())
        except self.printer.command_error as e:
            logging.info("gcode_button %s: %s", self.name, e)
            self._gcode.respond_error(f"Script of gcode_button '{self.name}' failed: {e}")


def load_config_prefix(config: ConfigWrapper) -> GCodeButton:
    """Section [gcode_button NAME]."""
    button = GCodeButton(config)
    button.register()
    return button
