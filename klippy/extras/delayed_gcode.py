"""[delayed_gcode NAME]: runs a template some time after start-up, or after UPDATE_DELAYED_GCODE."""

from __future__ import annotations

import logging
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer


class DelayedGcode:
    """One template with a timer. It may set its own timer again; then it repeats."""

    def __init__(self, printer: Printer, name: str, template: Any, initial_delay_s: float) -> None:
        self.printer = printer
        self.name = name
        self.reactor = printer.get_reactor()
        self.gcode = printer.lookup_object("gcode")
        self._template = template
        self._delay_s = initial_delay_s
        self._timer = self.reactor.register_timer(self._run)
        self._running = False
        self._again_at: float | None = None

    def register(self) -> None:
        """Make command and event known."""
        self.printer.register_event_handler("klippy:ready", self._handle_ready)
        self.gcode.register_mux_command(
            "UPDATE_DELAYED_GCODE", "ID", self.name, self.cmd_UPDATE_DELAYED_GCODE,
            desc=self.cmd_UPDATE_DELAYED_GCODE_help,
        )  # fmt: skip

    def _handle_ready(self) -> None:
        self._set(self._delay_s)

    def _set(self, delay_s: float) -> None:
        """0: never."""
        at = self.reactor.monotonic() + delay_s if delay_s else self.reactor.NEVER
        if self._running:
            self._again_at = at  # the timer's callback returns it
        else:
            self.reactor.update_timer(self._timer, at)

    def _run(self, eventtime: float) -> float:
        self._running, self._again_at = True, None
        try:
            self.gcode.run_script(self._template.render())
        except self.gcode.error as e:
            logging.info("delayed_gcode %s: %s", self.name, e)
        except Exception:
            logging.exception("delayed_gcode %s: internal error", self.name)
        finally:
            self._running = False
        return float(self.reactor.NEVER if self._again_at is None else self._again_at)

    cmd_UPDATE_DELAYED_GCODE_help = "Update the duration of a delayed_gcode"

    def cmd_UPDATE_DELAYED_GCODE(self, gcmd: GCodeCommand) -> None:
        """Run it in DURATION seconds; 0 cancels it."""
        self._set(gcmd.get_float("DURATION", minval=0.0))


def load_config_prefix(config: ConfigWrapper) -> DelayedGcode:
    """Section [delayed_gcode NAME]."""
    printer = config.get_printer()
    template = printer.load_object(config, "gcode_macro").load_template(config, "gcode")
    delay_s = config.getfloat("initial_duration", 0.0, minval=0.0)
    delayed = DelayedGcode(printer, config.get_name().split(None, 1)[1], template, delay_s)
    delayed.register()
    return delayed
