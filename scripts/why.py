#!/usr/bin/env python3
"""Names the cause of the last stop in a log of the host, with its evidence.

    scripts/why.py klippy.log

The text of a stop says what the printer noticed. Why that came about is in the statistics of the last seconds: how late
the host's timers came, damaged and repeated bytes of the line, swapping, clock and supply voltage of the computer.

    log ─► Stop: text, figures of the last seconds ─► RULES, the first that fits ─► a heading of docs/guides/Trouble.md
"""

from __future__ import annotations

import in_venv

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from log_extract import read_stats

ROOT = Path(__file__).resolve().parent.parent
PAGE = "docs/guides/Trouble.md"
UNKNOWN = "unknown"
LAST_S = 5.0  # before the stop
LATE_S = 0.080  # a heater without a command for 100 ms switches off
SWAP_PAGES_PER_S = 100.0
DAMAGED_SHARE = 0.002  # of the bytes received
CLOCK_SHARE = 0.75  # of the highest clock in the log
_STATS = re.compile(r"Stats (\d+\.\d+): (.*)")
_STOP = re.compile(r"error: Transition to shutdown state: (.*)")
_ENDS = re.compile(
    r"Starting Ferrite|Restarting printer|Exiting SD card print|Virtual sdcard|Reactor time at shutdown"
)
_PLAIN = ("Stats ", "Upcoming ", "Starting SD card", "G-code read lately", "Read ", "Host version", "Args:")


@dataclass(slots=True)
class Stop:
    """What the log has of its last stop. Figures are of the last seconds before; `grown`: by how much in that time."""

    text: str = ""
    is_shutdown: bool = False
    is_over: bool = False  # the host ended by itself, or goes on
    time_s: float = 0.0
    rows: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    clock_max: float = 0.0

    def last(self) -> list[dict[str, float]]:
        return [row for time_s, row in self.rows if time_s >= self.time_s - LAST_S]

    def max_of(self, name: str) -> float:
        return max(
            (value for row in self.last() for key, value in row.items() if ends(key, name)), default=0.0
        )

    def min_of(self, name: str) -> float:
        return min(
            (value for row in self.last() for key, value in row.items() if ends(key, name)), default=0.0
        )

    def grown(self, name: str) -> float:
        """The MCU with the largest growth."""
        rows = self.last()
        keys = {key for row in rows for key in row if ends(key, name)}
        return max((rows[-1].get(key, 0.0) - rows[0].get(key, 0.0) for key in keys), default=0.0)


def ends(key: str, name: str) -> bool:
    return key == name or key.endswith("." + name)


Fits = Callable[[Stop], str]  # the evidence, "" if it does not fit


def undervoltage(stop: Stop) -> str:
    return "the computer reported too little supply voltage" if stop.max_of("undervoltage") else ""


def late(stop: Stop) -> str:
    late_s = stop.max_of("late")
    return f"the host's timers came up to {late_s:.2f} s late" if late_s >= LATE_S else ""


def swapping(stop: Stop) -> str:
    pages = stop.max_of("swap")
    return (
        f"{pages:.0f} pages a second were swapped; {late(stop)}"
        if pages > SWAP_PAGES_PER_S and late(stop)
        else ""
    )


def throttled(stop: Stop) -> str:
    clock = stop.min_of("clock")
    slow = 0.0 < clock < CLOCK_SHARE * stop.clock_max
    if not late(stop) or not (stop.max_of("throttled") or slow):
        return ""
    return f"clock {clock:.0f} MHz of {stop.clock_max:.0f} MHz; {late(stop)}"


def damaged(stop: Stop) -> str:
    wrong, read = stop.grown("bytes_invalid"), stop.grown("bytes_read")
    found = wrong > 20 and wrong > DAMAGED_SHARE * max(read, 1.0)
    return (
        f"{wrong:.0f} of {wrong + read:.0f} bytes received in the last {LAST_S:.0f} s were damaged"
        if found
        else ""
    )


def silent(stop: Stop) -> str:
    """Nothing damaged, but sent again and again."""
    again = stop.grown("bytes_retransmit")
    return f"{again:.0f} bytes were sent again, the ones that arrived were whole" if again > 100 else ""


def healthy_line(stop: Stop) -> str:
    return "" if silent(stop) or damaged(stop) else "the line to the board worked to the end"


def always(stop: Stop) -> str:
    return "the message of the stop says so"


def causes() -> dict[str, tuple[str, str]]:
    """Heading of the page -> (what happened, what to check); nothing where the page is not installed."""
    try:
        text = (ROOT / PAGE).read_text(encoding="utf-8")
    except OSError:
        return {}
    found = re.findall(r"^## (.+)\n\n(.+(?:\n.+)*)\n\nCheck: (.+(?:\n.+)*)", text, re.MULTILINE)
    return {key: (" ".join(says.split()), " ".join(check.split())) for key, says, check in found}


LATE_TEXT = (
    "Timer too close|Missed scheduling|No next step|Rescheduled timer in the past|Stepper too far in past"
    "|no phase command|no control for|Lost communication"
    "|no samples from the induction unit|exceed max_duration|not refreshed in time"
)
STEPS_TEXT = (
    "Timer too close|No next step|Stepper too far in past|Rescheduled timer in the past|Missed scheduling"
)
# The first that fits. A text that comes from a heater's own section before those about lateness in general.
RULES: tuple[tuple[str, str, Fits], ...] = (
    ("M112", r"^Shutdown due to M112", always),
    ("Emergency stop of a client", r"^Shutdown due to webhooks", always),
    ("Emergency stop of a macro", r"^Shutdown due to ", always),
    ("Disk full", r"No space left on device", always),
    ("Brown-out", r"spontaneous restart|Watchdog", undervoltage),
    ("Board reset", r"spontaneous restart|Watchdog|sentinel timer", always),
    ("Signal frozen", r"[Cc]oil(?:'s)? signal stands still", always),
    ("Signal at its end", r"Induction coil signal at the end|signal clipped", always),
    ("No nozzle in the coil", r"is the nozzle missing|Induction coil signal above", always),
    ("No coil signal", r"signal was that of no current", always),
    ("No coil signal", r"Induction coil signal below|coil's signal reads .* below min_temp", always),
    ("Nozzle too hot", r"more than .* above max_temp", always),
    ("Bridge stuck on", r"warms with the heater off|Induction coil carries current", always),
    ("Signal frozen", r"Induction coil signal does not follow", always),
    ("Signal jumps", r"Induction coil signal changed faster", always),
    ("Heating too slow", r"heating too slow", always),
    ("No valid temperature", r"no valid nozzle temperature", always),
    ("Under-voltage", LATE_TEXT, lambda stop: late(stop) and undervoltage(stop)),
    ("Swapping", LATE_TEXT, swapping),
    ("Slow clock", LATE_TEXT, throttled),
    ("Host too busy", LATE_TEXT, late),
    ("Damaged line", LATE_TEXT, damaged),
    ("Lost connection", LATE_TEXT, silent),
    ("Samples stopped", r"no samples from the induction unit", healthy_line),
    ("Step rate", STEPS_TEXT, healthy_line),
    ("Sensor open or shorted", r"ADC out of range|temperature sensor .* range", always),
    ("Converter fault", r"Thermocouple reader fault|MAX31\d\d\d", always),
    ("Heater too weak", r"not heating at expected rate", always),
    ("Motor driver", r"TMC|drv_err|Unable to read tmc|Unable to write tmc", always),
    ("Endstop stuck", r"still triggered|triggered prior to movement", always),
    ("Endstop not reached", r"No trigger on", always),
    ("No connection", r"Unable to connect", always),
    ("Firmware", r"Command parser error|Invalid command|[Pp]rotocol error|Message encode", always),
    ("Config file", r"Unable to open config file|Include file .* does not exist|not valid UTF-8", always),
    ("Internal error", r"[Ii]nternal error|Traceback", always),
    ("Config", r"Option .|[Ss]ection .|Unable to parse|in the config|pin |\.cfg|includes itself", always),
    ("Macro", r"Error evaluating|called recursively|action_raise_error", always),
    ("File", r"Unable to (open|read) (the G-code )?file", always),
    ("Wrong command", r"out of range|below minimum|Must home|must (have|be)|needs a|missing |is not ", always),
)  # fmt: skip


def read(lines: Iterable[str]) -> Stop:
    """The last stop of a log."""
    stop = Stop()
    collecting: list[str] | None = None
    printing = False
    for raw in lines:
        line = raw.rstrip("\n")
        stats = _STATS.match(line)
        if collecting is not None and (stats or _ENDS.match(line) or line.startswith(_PLAIN)):
            stop.text, collecting = "\n".join(collecting), None
        if stats:
            time_s, row = float(stats[1]), dict(read_stats(stats[2]))
            if not stop.is_shutdown or time_s <= stop.time_s + 0.001 or not stop.time_s:
                stop.rows = [*stop.rows[-60:], (time_s, row)]
                stop.time_s = max(stop.time_s, time_s)
            stop.clock_max = max(
                [stop.clock_max, *(value for key, value in row.items() if ends(key, "clock"))]
            )
        elif line.startswith(("Starting Ferrite", "Restarting printer")):
            stop, printing = Stop(clock_max=stop.clock_max), False
        elif stopped := _STOP.match(line):
            collecting, stop.is_shutdown, stop.time_s = [stopped[1]], True, 0.0
        elif line.startswith("Starting SD card print"):
            printing, stop.text = True, ""
        elif line.startswith("Exiting SD card print"):
            printing = False
        elif line.startswith(("error: ", "warning: ")) and not stop.is_shutdown and not collecting:
            if line.startswith("error: ") or printing:
                collecting = [line.partition(": ")[2]]
        elif collecting is not None:
            collecting.append(line)
    if collecting is not None:
        stop.text = "\n".join(collecting)
    stop.is_over = not printing
    return stop


def cause_of(stop: Stop) -> tuple[str, str]:
    """The cause (a heading of the page, or UNKNOWN), and its evidence."""
    for key, pattern, fits in RULES:
        if stop.text and re.search(pattern, stop.text) and (evidence := fits(stop)):
            return key, evidence
    if not stop.text and not stop.is_over:
        return "Host ended", "the log breaks off during a print"
    return UNKNOWN, "no rule fits" if stop.text else "the log has no stop"


def anchor(key: str) -> str:
    """Of a heading, as the page's reader makes it."""
    return re.sub(r"[^a-z0-9 -]", "", key.lower()).replace(" ", "-")


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description="Name the cause of the last stop in a log of the host.")
    parser.add_argument("log", type=Path, help="klippy.log")
    options = parser.parse_args(argv)
    try:
        with options.log.open(encoding="utf-8", errors="replace") as file:
            stop = read(file)
    except OSError as e:
        print(f"why: {options.log}: {e.strerror}", file=sys.stderr)
        return 2
    key, evidence = cause_of(stop)
    says, check = causes().get(key, ("", ""))
    lines = [f"{key}: {says}".rstrip(": "), f"Evidence: {evidence}."]
    if stop.text:
        lines.append(f"The printer said: {stop.text.splitlines()[0]}")
    if check:
        lines += [f"Check: {check}", f"More: {PAGE}#{anchor(key)}"]
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
