"""[display_status]: M73 and M117 for displays and front ends."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

_VALID_S = 5.0  # an M73 counts that long after the print it belongs to has stopped


class DisplayStatus:
    """The object `display_status`."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self._progress: float | None = None
        self._progress_until = 0.0
        self.message: str | None = None

    def register(self) -> None:
        """Make the commands known."""
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command("M73", self.cmd_M73)
        gcode.register_command("M117", self.cmd_M117)
        gcode.register_command(
            "SET_DISPLAY_TEXT", self.cmd_SET_DISPLAY_TEXT, desc="Set or clear the display message"
        )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """Progress 0..1 as set by M73, else by the file position; message or None."""
        sd = self.printer.lookup_object("virtual_sdcard", None)
        if self._progress is not None and eventtime > self._progress_until:
            still_printing = (sd is not None and sd.is_active()) or self._is_printing(eventtime)
            if still_printing:
                self._progress_until = eventtime + _VALID_S
            else:
                self._progress = None
        progress = self._progress
        if progress is None:
            progress = sd.progress() if sd is not None else 0.0
        return {"progress": progress, "message": self.message}

    def _is_printing(self, eventtime: float) -> bool:
        idle = self.printer.lookup_object("idle_timeout", None)
        return idle is not None and idle.get_status(eventtime)["state"] == "Printing"

    def cmd_M73(self, gcmd: GCodeCommand) -> None:
        """Set the progress in percent."""
        percent = gcmd.get_float("P", 0.0)
        self._progress = min(1.0, max(0.0, percent / 100.0))
        self._progress_until = self.printer.get_reactor().monotonic() + _VALID_S

    def cmd_M117(self, gcmd: GCodeCommand) -> None:
        """Show a message."""
        self.message = gcmd.get_raw_command_parameters() or None

    def cmd_SET_DISPLAY_TEXT(self, gcmd: GCodeCommand) -> None:
        """Show a message, or none."""
        self.message = gcmd.get("MSG", None)


def load_config(config: ConfigWrapper) -> DisplayStatus:
    """Section [display_status]."""
    status = DisplayStatus(config.get_printer())
    status.register()
    return status
