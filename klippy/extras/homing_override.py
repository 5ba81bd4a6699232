"""[homing_override]: G28 runs the G-code of the section; a G28 inside it is the plain one."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer


class HomingOverride:
    """Replaces G28 for the axes it is responsible for."""

    def __init__(self, printer: Printer, axes: str, start_pos: list[float | None], template: Any) -> None:
        self.printer = printer
        self.axes = axes
        self.start_pos = start_pos
        self.template = template
        self.in_script = False
        self.prev_G28: Any = None

    def register_commands(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        self.prev_G28 = gcode.register_command("G28", None)
        gcode.register_command("G28", self.cmd_G28)

    def cmd_G28(self, gcmd: GCodeCommand) -> None:
        """G28 [X] [Y] [Z]."""
        named = [a for a in "XYZ" if gcmd.get(a, None) is not None]
        ours = not named or any(a in self.axes for a in named)
        if self.in_script or not ours:
            self.prev_G28(gcmd)
            return
        self._assume_start()
        context = self.template.create_template_context()
        context["params"] = gcmd.get_command_parameters()
        context["rawparams"] = gcmd.get_raw_command_parameters()
        self.in_script = True
        try:
            self.template.run_gcode_from_command(context)
        finally:
            self.in_script = False

    def _assume_start(self) -> None:
        """set_position_*: the head is said to be there, so that the script may move before homing."""
        axes = [i for i, value in enumerate(self.start_pos) if value is not None]
        if not axes:
            return
        toolhead = self.printer.lookup_object("toolhead")
        place = toolhead.get_position()
        for axis in axes:
            place[axis] = self.start_pos[axis]
        toolhead.set_position(place, homing_axes="".join("xyz"[axis] for axis in axes))


def load_config(config: ConfigWrapper) -> HomingOverride:
    printer = config.get_printer()
    printer.load_object(config, "homing")
    template = printer.load_object(config, "gcode_macro").load_template(config, "gcode")
    start = [config.getfloat(f"set_position_{axis}", None) for axis in "xyz"]
    override = HomingOverride(printer, config.get("axes", "XYZ").upper(), start, template)
    override.register_commands()
    return override
