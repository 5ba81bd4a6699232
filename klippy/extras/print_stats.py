"""The object `print_stats`: state, durations and filament of the running print."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer


class PrintStats:
    """States: standby printing paused complete cancelled error."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.reactor = printer.get_reactor()
        self.reset()

    def register(self) -> None:
        """Make the command known."""
        self.printer.lookup_object("gcode").register_command(
            "SET_PRINT_STATS_INFO", self.cmd_SET_PRINT_STATS_INFO, desc=self.cmd_SET_PRINT_STATS_INFO_help
        )

    def reset(self) -> None:
        """Forget the print."""
        self.state = "standby"
        self.filename = ""
        self.error_message = ""
        self._begin: float | None = None
        self._end: float | None = None
        self._pause_begin: float | None = None
        self._paused_s = (
            0.0  # time from the start that was not printing: pauses, and heating before the first move
        )
        self._started_moving: float | None = None
        self.filament_used_mm = 0.0
        self._last_e_mm = 0.0
        self._layers: dict[str, int | None] = {"total_layer": None, "current_layer": None}

    def set_current_file(self, filename: str) -> None:
        """A file was loaded."""
        self.reset()
        self.filename = filename

    # --- events of the print ---
    def note_start(self) -> None:
        """Start, or resume after a pause."""
        now, begins = self.reactor.monotonic(), self._begin is None
        if begins:
            self._begin = now
        elif self._pause_begin is not None:
            self._paused_s += now - self._pause_begin
        self._pause_begin = None
        self._last_e_mm = self._e_position_mm(now)
        self.state = "printing"
        self.error_message = ""
        if begins:
            self.printer.send_event("print_stats:begin")

    def note_pause(self) -> None:
        """Paused."""
        if self._pause_begin is None:
            now = self.reactor.monotonic()
            self._update_filament(now)
            self._pause_begin = now
        if self.state != "error":
            self.state = "paused"

    def note_complete(self) -> None:
        """The file ended."""
        self._finish("complete")

    def note_error(self, message: str) -> None:
        """A command of the file failed."""
        self._finish("error", message)

    def note_cancel(self) -> None:
        """The user gave up."""
        self._finish("cancelled")

    def _finish(self, state: str, message: str = "") -> None:
        if self._begin is None:
            return
        now = self.reactor.monotonic()
        if self._pause_begin is not None:
            self._paused_s += now - self._pause_begin
            self._pause_begin = None
        elif self.state == "printing":
            self._update_filament(now)
        self.state, self.error_message = state, message
        self._end = now

    # --- filament ---
    def _e_position_mm(self, eventtime: float) -> float:
        """Extruder position as commanded, before the extrude factor."""
        gcode_move = self.printer.lookup_object("gcode_move", None)
        if gcode_move is None:
            return 0.0
        status = gcode_move.get_status(eventtime)
        return float(status["position"][3]) / (float(status.get("extrude_factor", 1.0)) or 1.0)

    def _update_filament(self, eventtime: float) -> None:
        position = self._e_position_mm(eventtime)
        moved = position - self._last_e_mm
        self._last_e_mm = position
        self.filament_used_mm += moved
        if self._started_moving is None and self.filament_used_mm > 0.0:
            self._started_moving = eventtime

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """Durations in s, filament in mm."""
        if self.state == "printing":
            self._update_filament(eventtime)
        total_s = printed_s = 0.0
        if self._begin is not None:
            now = self._end if self._end is not None else eventtime
            total_s = now - self._begin
            if self._started_moving is not None:
                paused_s = self._paused_s + (
                    now - self._pause_begin if self._pause_begin is not None else 0.0
                )
                printed_s = max(0.0, now - self._started_moving - paused_s)
        return {
            "filename": self.filename,
            "total_duration": total_s,
            "print_duration": printed_s,
            "filament_used": self.filament_used_mm,
            "state": self.state,
            "message": self.error_message,
            "info": dict(self._layers),
        }

    cmd_SET_PRINT_STATS_INFO_help = "Pass slicer info like layer act and total to klipper"

    def cmd_SET_PRINT_STATS_INFO(self, gcmd: GCodeCommand) -> None:
        """Layer numbers of the slicer."""
        total = gcmd.get_int("TOTAL_LAYER", self._layers["total_layer"], minval=0)
        current = gcmd.get_int("CURRENT_LAYER", self._layers["current_layer"], minval=0)
        if total == 0:
            total = current = None
        elif total is not None and current is not None:
            current = min(current, total)
        self._layers = {"total_layer": total, "current_layer": current}


def load_config(config: ConfigWrapper) -> PrintStats:
    """Loaded by [virtual_sdcard]."""
    stats = PrintStats(config.get_printer())
    stats.register()
    return stats
