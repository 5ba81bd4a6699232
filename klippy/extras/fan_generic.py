"""[fan_generic NAME]: a fan set by SET_FAN_SPEED."""

from __future__ import annotations

from configfile import ConfigWrapper
from gcode import GCodeCommand

from . import fan


class PrinterFanGeneric:
    """The object `fan_generic NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.fan_name = config.get_name().split(maxsplit=1)[1]  # as SET_FAN_SPEED names it
        self.fan = fan.Fan(config, default_shutdown_speed=0.0)
        self.get_status = self.fan.get_status
        self._templates = self.printer.load_object(config, "template_evaluator")

    def register(self) -> None:
        """Make the command known."""
        self.printer.lookup_object("gcode").register_mux_command(
            "SET_FAN_SPEED", "FAN", self.fan_name, self.cmd_SET_FAN_SPEED, desc="Sets the speed of a fan"
        )

    def cmd_SET_FAN_SPEED(self, gcmd: GCodeCommand) -> None:
        """SPEED 0..1, in step with the moves queued so far; or TEMPLATE=name to follow."""
        if gcmd.get("TEMPLATE", None) is not None:
            self._templates.assign(
                self, gcmd, lambda text: self.fan.set_speed(min(1.0, max(0.0, float(text))))
            )
            return
        self._templates.forget(self)
        self.fan.set_speed_from_command(gcmd.get_float("SPEED", minval=0.0, maxval=1.0))


def load_config_prefix(config: ConfigWrapper) -> PrinterFanGeneric:
    """Section [fan_generic NAME]."""
    generic = PrinterFanGeneric(config)
    generic.register()
    return generic
