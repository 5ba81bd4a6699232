"""The `Stats` line of the log each second, and the object `system_stats`."""

from __future__ import annotations

import logging
import os
import time
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

_PERIOD_S = 1.0


class SystemStats:
    """Load, processor time and free memory of this computer."""

    def __init__(self) -> None:
        self._status: dict[str, Any] = {"sysload": 0.0, "cputime": 0.0, "memavail": 0}

    def stats(self, eventtime: float) -> tuple[bool, str]:
        """For the statistics line."""
        cputime_s = time.process_time()
        load = os.getloadavg()[0]
        self._status = {"sysload": load, "cputime": cputime_s, "memavail": _available_kb()}
        return False, f"sysload={load:.2f} cputime={cputime_s:.3f} memavail={self._status['memavail']}"

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """As of the last statistics line."""
        return self._status


def _available_kb() -> int:
    try:
        with open("/proc/meminfo", "rb", buffering=0) as file:
            return int(file.read(512).partition(b"MemAvailable:")[2].split(maxsplit=1)[0])
    except (OSError, ValueError, IndexError):
        return 0


class PrinterStats:
    """Asks every object that has `stats(eventtime) -> (is_active, text)` once a second."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.reactor = printer.get_reactor()
        self._timer = self.reactor.register_timer(self._report)
        self._sources: list[Any] = []

    def register(self) -> None:
        """Start once the printer is ready."""
        self.printer.register_event_handler("klippy:ready", self._handle_ready)

    def _handle_ready(self) -> None:
        self._sources = [obj.stats for _, obj in self.printer.lookup_objects() if hasattr(obj, "stats")]
        if self.printer.get_start_args().get("debugoutput") is None:
            self.reactor.update_timer(self._timer, self.reactor.NOW)

    def _report(self, eventtime: float) -> float:
        reports = [source(eventtime) for source in self._sources]
        if any(active for active, _ in reports):
            # an object may be known by two names: say everything once
            texts = dict.fromkeys(text for _, text in reports if text)
            logging.info("Stats %.1f: %s", eventtime, " ".join(texts))
        return eventtime + _PERIOD_S


def load_config(config: ConfigWrapper) -> PrinterStats:
    """Always loaded."""
    printer = config.get_printer()
    printer.add_object("system_stats", SystemStats())
    stats = PrinterStats(printer)
    stats.register()
    return stats
