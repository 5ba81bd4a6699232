"""[sdcard_loop]: the lines between SDCARD_LOOP_BEGIN COUNT=n and SDCARD_LOOP_END of a file are printed n times.

COUNT=0: without end, or until SDCARD_LOOP_DESIST. Loops may lie in each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer


@dataclass(slots=True)
class _Loop:
    start: int  # in the file, bytes
    left: int | None  # rounds after this one; None: no end


class SDCardLoop:
    """The object `sdcard_loop`."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self._loops: list[_Loop] = []

    def register(self, card: Any) -> None:
        """Make the commands known."""
        self._card = card
        gcode = self.printer.lookup_object("gcode")
        for name, help_text in (
            ("SDCARD_LOOP_BEGIN", "Begins a looped section in the SD file."),
            ("SDCARD_LOOP_END", "Ends a looped section in the SD file."),
            ("SDCARD_LOOP_DESIST", "Stops iterating the current loop stack."),
        ):
            gcode.register_command(name, getattr(self, f"cmd_{name}"), desc=help_text)
        self.printer.register_event_handler("virtual_sdcard:reset_file", self._loops.clear)

    def _check_from_file(self, gcmd: GCodeCommand) -> None:
        if not self._card.is_cmd_from_sd():
            raise gcmd.error(f"{gcmd.get_command()} only counts in a file that is being printed")

    def cmd_SDCARD_LOOP_BEGIN(self, gcmd: GCodeCommand) -> None:
        """The loop begins behind this line."""
        self._check_from_file(gcmd)
        count = gcmd.get_int("COUNT", minval=0)
        self._loops.append(_Loop(self._card.get_file_position(), count - 1 if count else None))

    def cmd_SDCARD_LOOP_END(self, gcmd: GCodeCommand) -> None:
        """Back to the beginning, or on."""
        self._check_from_file(gcmd)
        if not self._loops:
            return  # ended by SDCARD_LOOP_DESIST meanwhile
        loop = self._loops[-1]
        if loop.left == 0:
            self._loops.pop()
            return
        if loop.left is not None:
            loop.left -= 1
        self._card.set_file_position(loop.start)

    def cmd_SDCARD_LOOP_DESIST(self, gcmd: GCodeCommand) -> None:
        """The running round of each loop is the last."""
        for loop in self._loops:
            loop.left = 0


def load_config(config: ConfigWrapper) -> SDCardLoop:
    """Section [sdcard_loop]."""
    loop = SDCardLoop(config.get_printer())
    loop.register(config.get_printer().load_object(config, "virtual_sdcard"))
    return loop
