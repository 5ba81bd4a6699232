"""The `Stats` line of the log each second, and the object `system_stats`."""

from __future__ import annotations

import logging
import math
import os
import time
from typing import Any

from configfile import ConfigWrapper
from reactor import void
from roles import Printer

_PERIOD_S = 1.0
READ_S = 0.9  # of this computer's own time
_PI_THROTTLED = "/sys/devices/platform/soc/soc:firmware/get_throttled"


class SystemStats:
    """This computer: load, processor time, memory, swapping, clock, supply; and how late the host's timers come."""

    def __init__(self, reactor: Any) -> None:
        self._reactor = reactor
        self._status: dict[str, Any] = {"sysload": 0.0, "cputime": 0.0, "memavail": 0}
        self._swapped, self._read_s, self._text = 0, -math.inf, ""

    def stats(self, eventtime: float) -> tuple[bool, str]:
        """For the statistics line."""
        late_s, self._reactor.late_s = self._reactor.late_s, 0.0
        now_s = time.monotonic()  # simulated seconds pass by hundreds while this computer changes nothing
        if now_s - self._read_s > READ_S:
            self._read(now_s)
        return False, f"{self._text} late={late_s:.3f}"

    def _read(self, now_s: float) -> None:
        facts = read_computer()
        swapped, period_s = facts.pop("swapped", 0), now_s - self._read_s
        rate = max(0.0, (swapped - self._swapped) / period_s)
        self._swapped, self._read_s = swapped, now_s
        self._status = {name: facts[name] for name in ("sysload", "cputime", "memavail")}
        texts = [
            f"{name}={value:.3f}" if isinstance(value, float) else f"{name}={value}"
            for name, value in facts.items()
        ]
        self._text = f"{' '.join(texts)} swap={rate:.0f}"

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """As of the last statistics line."""
        return self._status


def read_computer() -> dict[str, Any]:
    """Load; CPU seconds of this program; KB of free memory; pages swapped since the start of the computer.

    Where the computer reports them: clock of the first core (MHz), whether it was throttled or had too little voltage.
    """
    facts: dict[str, Any] = {"sysload": round(os.getloadavg()[0], 2), "cputime": time.process_time()}
    facts["memavail"] = _count("/proc/meminfo", b"MemAvailable:")
    facts["swapped"] = _count("/proc/vmstat", b"pswpin ") + _count("/proc/vmstat", b"pswpout ")
    if clock_khz := _count("/sys/devices/system/cpu/cpu0/cpufreq/scaling_cur_freq"):
        facts["clock"] = clock_khz // 1000
    flags = _read(_PI_THROTTLED)  # as `vcgencmd get_throttled`: bit 0 voltage, 1 capped, 2 throttled
    if flags:
        bits = int(flags, 16)
        facts |= {"undervoltage": bits & 1, "throttled": int(bits & 6 > 0)}
    return facts


def _read(path: str) -> bytes:
    try:
        with open(path, "rb", buffering=0) as file:
            return file.read(8192)
    except OSError:
        return b""


def _count(path: str, name: bytes = b"") -> int:
    """The whole number behind `name` in a file of the kernel; 0 if there is none."""
    try:
        return int(_read(path).partition(name)[2].split(maxsplit=1)[0] if name else _read(path) or 0)
    except (ValueError, IndexError):
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
        self.printer.register_event_handler(
            "klippy:shutdown", lambda: void(self._report(self.reactor.monotonic()))
        )

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
    printer.add_object("system_stats", SystemStats(printer.get_reactor()))
    stats = PrinterStats(printer)
    stats.register()
    return stats
