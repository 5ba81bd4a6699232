"""The host as it prints a file from its own storage, without the machine: commands go to a file, time is virtual.

    sd_host.py CONFIG GCODE OUT DICT [--live]

--live: paced as in a print under way, by a clock that jumps from one thing to do to the next; without it, as in batch
mode. Beside that it is the product: virtual_sdcard, dispatch, planning, steps, timers.
"""

from __future__ import annotations

import argparse
import gc
import logging
import os
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "klippy"))

from printer import Printer
from reactor import FdPoll, Reactor

POLL_S = 5.0
OVER = ("complete", "error", "cancelled")


class VirtualTime:
    """Jumps to the next timer."""

    runs_by_itself = False

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def wait(self, until: float, poll: FdPoll) -> None:
        if until < Reactor.NEVER:
            self.now = max(self.now, until)


class SDHost:
    """One run of the host."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._file = Path(options.gcode).resolve()
        self._live = options.live
        self.reactor = Reactor(VirtualTime())
        self.printer = Printer(
            self.reactor,
            {
                "config_file": os.path.abspath(options.config), "apiserver": None, "start_reason": "startup",
                "config_overrides": [("virtual_sdcard", "path", str(self._file.parent))], "gcode_fd": None,
                "debuginput": "none", "debugoutput": options.out, "dictionary": options.dict,
                "software_version": "bench", "cpu_info": "bench",
            },
        )  # fmt: skip

    def run(self) -> str:
        self.printer.register_event_handler("klippy:ready", self._start)
        return self.printer.run()

    def _start(self) -> None:
        self.reactor.register_callback(self._print)

    def _go_live(self, toolhead: Any) -> None:
        start_s = self.reactor.monotonic() - toolhead.get_last_move_time()
        toolhead.mcu.estimated_print_time = lambda eventtime: eventtime - start_s
        toolhead.can_pause = True
        self.printer.lookup_object("gcode").is_fileinput = False  # an error does not end the run

    def _print(self, eventtime: float) -> None:
        lookup = self.printer.lookup_object
        gcode, stats = lookup("gcode"), lookup("print_stats")
        gcode.run_script("G28")
        if self._live:
            self._go_live(lookup("toolhead"))
        gcode.run_script(f"SDCARD_PRINT_FILE FILENAME={self._file.name}")
        while stats.get_status(eventtime)["state"] not in OVER:
            eventtime = self.reactor.pause(self.reactor.monotonic() + POLL_S)
        if stats.get_status(eventtime)["state"] != "complete":
            self.printer.request_exit("error_exit")
        gcode.request_restart("exit")


def main() -> int:
    parser = argparse.ArgumentParser(description="Print a file without a machine.")
    for name in ("config", "gcode", "out", "dict"):
        parser.add_argument(name)
    parser.add_argument("--live", action="store_true")
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    gc.collect()
    return int(SDHost(options).run() != "exit")


if __name__ == "__main__":
    sys.exit(main())
