#!/usr/bin/env python3
"""Makes a readable story, the config files and plots out of the host's log.

scripts/log_extract.py klippy.log                       the story, on stdout
scripts/log_extract.py klippy.log --config DIR          each config of the log as DIR/config-1.cfg, ...
scripts/log_extract.py klippy.log --plot OUT.png        temperatures, power and the link over time
"""

from __future__ import annotations

import in_venv

import argparse
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

_STATS = re.compile(r"Stats (\d+\.\d+): (.*)")
_ENTRY = re.compile(r"(?:(?P<group>[\w.-]+):(?=\s)|(?P<name>\w+)=(?P<value>\S+))")
# What the host says of itself, in a line without a group of its own: it comes behind whatever group was last
_HOST = {
    "gcodein",
    "sd_pos",
    "print_time",
    "buffer_time",
    "print_stall",
    "sysload",
    "cputime",
    "memavail",
    "clock",
    "undervoltage",
    "throttled",
    "swap",
    "late",
}
_CONFIG_BEGIN, _CONFIG_END = "===== Config file =====", "======================="

# Lines of the log that belong to the story, with what they mean
_STORY = (
    (re.compile(r"Starting Ferrite.*"), "start"),
    (re.compile(r"Restarting printer"), "restart"),
    (re.compile(r"Host version: .*"), "version"),
    (re.compile(r"Loaded MCU '.*"), "mcu"),
    (re.compile(r"Configured MCU '.*"), "mcu"),
    (re.compile(r"Attempting MCU '.*"), "mcu"),
    (re.compile(r"(Starting|Exiting) SD card print.*"), "print"),
    (re.compile(r"save_config: .*|SAVE_CONFIG: .*"), "config"),
    (re.compile(r"error: .*"), "ERROR"),
    (re.compile(r"warning: .*"), "warning"),
    (re.compile(r"Traceback .*"), "TRACEBACK"),
    (re.compile(r"API client dropped: .*"), "api"),
    (re.compile(r"Simulated printer: .* behind .*"), "late"),
)


@dataclass(frozen=True, slots=True)
class Event:
    """One line of the story; `time_s` is that of the statistics line before it, None before the first."""

    line: int
    time_s: float | None
    kind: str
    text: str


@dataclass(slots=True)
class Extract:
    """What was found in a log. `series`: name → (times in s, values)."""

    events: list[Event] = field(default_factory=list)
    configs: list[str] = field(default_factory=list)
    series: dict[str, tuple[list[float], list[float]]] = field(default_factory=dict)


def read_stats(text: str) -> Iterator[tuple[str, float]]:
    """`a: x=1 y=2 b: z=3 sysload=4` → ("a.x", 1.0), ("a.y", 2.0), ("b.z", 3.0), ("sysload", 4.0).

    What is no number is left out.
    """
    group = ""
    for match in _ENTRY.finditer(text):
        if match["group"] is not None:
            group = match["group"]
            continue
        try:
            value = float(match["value"])
        except ValueError:
            continue
        name = match["name"]
        yield (f"{group}.{name}" if group and name not in _HOST else name), value


def extract(lines: Iterable[str]) -> Extract:
    """Read a log."""
    found = Extract()
    config: list[str] | None = None
    now_s: float | None = None
    for number, raw in enumerate(lines, 1):
        line = raw.rstrip("\n")
        if config is not None:
            if line == _CONFIG_END:
                found.configs.append("\n".join(config) + "\n")
                config = None
            else:
                config.append(line)
            continue
        if line == _CONFIG_BEGIN:
            config = []
            continue
        stats = _STATS.match(line)
        if stats is not None:
            now_s = float(stats[1])
            for name, value in read_stats(stats[2]):
                times, values = found.series.setdefault(name, ([], []))
                if not times or times[-1] != now_s:
                    times.append(now_s)
                    values.append(value)
            continue
        for pattern, kind in _STORY:
            if pattern.fullmatch(line):
                found.events.append(Event(number, now_s, kind, line))
                break
    return found


def story(found: Extract) -> str:
    """The events, equal ones in a row as one line."""
    lines: list[str] = []
    before: tuple[str, str] | None = None
    count = 0
    for event in found.events:
        if (event.kind, event.text) == before:
            count += 1
            lines[-1] = re.sub(r"( \(\d+ times\))?$", f" ({count} times)", lines[-1], count=1)
            continue
        before, count = (event.kind, event.text), 1
        at = "         -" if event.time_s is None else f"{event.time_s:8.1f} s"
        lines.append(f"{at}  line {event.line:<7} {event.kind:<9} {event.text}")
    for name in sorted(found.series):
        if name.endswith((".temp", "sysload", "print_stall", "bytes_retransmit", "bytes_invalid")):
            values = found.series[name][1]
            lines.append(
                f"{name:<32} min {min(values):10.2f}  max {max(values):10.2f}  last {values[-1]:10.2f}"
            )
    return "\n".join(lines)


def plot(found: Extract, path: Path) -> None:
    """Temperatures, power and the link over time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = (
        ("temperature, °C", (".temp", ".target")),
        ("power", (".pwm", ".power_w")),
        ("round trip to the MCU, s", (".srtt", ".rto")),
        ("computer", ("sysload", "buffer_time", "print_stall")),
    )
    figure, axes = pyplot.subplots(len(rows), 1, sharex=True, figsize=(11, 12), layout="constrained")
    for axis, (title, endings) in zip(axes, rows, strict=True):
        for name in sorted(found.series):
            if name.endswith(endings):
                times, values = found.series[name]
                axis.plot(times, values, label=name, linewidth=1.0)
        axis.set_title(title, loc="left", fontsize=10)
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend(fontsize=7, loc="upper right")
    axes[-1].set_xlabel("host time, s")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Story, config and plots out of the host's log.")
    parser.add_argument("log", type=Path)
    parser.add_argument("--config", type=Path, metavar="DIR", help="write the configs found to this folder")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="plots of the statistics")
    options = parser.parse_args(sys.argv[1:] if argv is None else argv)
    try:
        with options.log.open(encoding="utf-8", errors="replace") as file:
            found = extract(file)
    except OSError as e:
        print(f"log_extract: {options.log}: {e.strerror}", file=sys.stderr)
        return 2
    if options.config:
        options.config.mkdir(parents=True, exist_ok=True)
        for number, text in enumerate(found.configs, 1):
            (options.config / f"config-{number}.cfg").write_text(text, encoding="utf-8")
    if options.plot:
        if not found.series:
            print("log_extract: the log has no statistics to plot", file=sys.stderr)
            return 2
        plot(found, options.plot)
    try:
        print(story(found))
    except BrokenPipeError:
        sys.stderr.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
