"""[idle_timeout]: what to do when nothing moved for long, and whether the machine prints, is ready, or idle."""

from __future__ import annotations

import logging
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

_DEFAULT_GCODE = "{% if 'heaters' in printer %}\nTURN_OFF_HEATERS\n{% endif %}\nM84"
_POLL_S = 0.5
_QUIET_S = 0.5  # motion must have ended that long before the printer counts as ready


class IdleTimeout:
    """States: Printing (something moves or a command runs), Ready, Idle (the time is over)."""

    def __init__(self, printer: Printer, timeout_s: float, script: Any) -> None:
        self.printer = printer
        self.reactor = printer.get_reactor()
        self.gcode = printer.lookup_object("gcode")
        self.idle_timeout = timeout_s
        self._script = script
        self._timer = self.reactor.register_timer(self._check)
        self.state = "Idle"
        self._since = 0.0  # start of printing
        self._last_busy = 0.0
        self._ending = False

    def register(self) -> None:
        """Make command and events known."""
        self.printer.register_event_handler("klippy:ready", self._handle_ready)
        self.printer.register_event_handler("toolhead:sync_print_time", self._handle_motion)
        self.gcode.register_command(
            "SET_IDLE_TIMEOUT", self.cmd_SET_IDLE_TIMEOUT, desc="Set the idle timeout in seconds"
        )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """State, and seconds printing."""
        printing_s = eventtime - self._since if self.state == "Printing" else 0.0
        return {"state": self.state, "printing_time": printing_s, "idle_timeout": self.idle_timeout}

    def _handle_ready(self) -> None:
        self._last_busy = self.reactor.monotonic()
        self.reactor.update_timer(self._timer, self._last_busy + _POLL_S)

    def _handle_motion(self, curtime: float, *times: float) -> None:
        """The toolhead began to move after a standstill."""
        if not self._ending:
            self._become("Printing", curtime)

    def _is_busy(self, eventtime: float) -> bool:
        if self.gcode.get_mutex().test():
            return True
        toolhead = self.printer.lookup_object("toolhead", None)
        if toolhead is None:
            return False
        status = toolhead.get_status(eventtime)
        return bool(status["print_time"] > status["estimated_print_time"])

    def _become(self, state: str, eventtime: float) -> None:
        if state == "Printing":
            self._last_busy = eventtime
        if state == self.state:
            return
        if state == "Printing":
            self._since = eventtime
        self.state = state
        toolhead = self.printer.lookup_object("toolhead", None)
        print_time = toolhead.get_status(eventtime)["print_time"] if toolhead is not None else 0.0
        self.printer.send_event(f"idle_timeout:{state.lower()}", print_time)

    def _check(self, eventtime: float) -> float:
        if self.printer.is_shutdown():
            return float(self.reactor.NEVER)
        if self._is_busy(eventtime):
            self._become("Printing", eventtime)
        elif self.state == "Printing" and eventtime > self._last_busy + _QUIET_S:
            self._become("Ready", eventtime)
        elif self.state == "Ready" and eventtime > self._last_busy + self.idle_timeout:
            self._go_idle(eventtime)
        return self.reactor.monotonic() + _POLL_S

    def _go_idle(self, eventtime: float) -> None:
        self._ending = True
        try:
            self.gcode.run_script(self._script.render())
        except Exception:
            logging.exception("idle_timeout: the gcode of the config failed")
        finally:
            self._ending = False
        self._become("Idle", self.reactor.monotonic())

    def cmd_SET_IDLE_TIMEOUT(self, gcmd: GCodeCommand) -> None:
        """Change the time until restart."""
        self.idle_timeout = gcmd.get_float("TIMEOUT", self.idle_timeout, above=0.0)
        gcmd.respond_info(f"idle_timeout: Timeout set to {self.idle_timeout:.2f} s")


def load_config(config: ConfigWrapper) -> IdleTimeout:
    """Always loaded; section [idle_timeout]."""
    printer = config.get_printer()
    timeout_s = config.getfloat("timeout", 600.0, above=0.0)
    script = printer.load_object(config, "gcode_macro").load_template(config, "gcode", _DEFAULT_GCODE)
    idle = IdleTimeout(printer, timeout_s, script)
    idle.register()
    return idle
