#!/usr/bin/env python3
"""Prints the large sample in closed loop and measures speed and memory against their limits (`make bench`).

The print runs as its own process, exactly as a user would run it, without trace and report, so that its peak
memory and its time are those of the printer stack alone. With --quick the small sample is printed.
Exit status 1 if a limit is missed.
"""

from __future__ import annotations

from bench_paths import ROOT  # isort: skip

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from sample_gcode import SampleMissing, sample_path

MIN_RATIO = 20.0  # simulated seconds per wall second, on two cores
MAX_MEMORY_MB = 300.0


@dataclass(frozen=True, slots=True)
class Run:
    """What one simulated print cost. Memory is the process's peak resident set in MB (1e6 bytes)."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    summary: Mapping[str, object]

    @property
    def simulated_s(self) -> float:
        return number(self.summary, "simulated_s")

    @property
    def ratio(self) -> float:
        return self.simulated_s / self.wall_s


class BenchError(Exception):
    """The print did not come to its end; the text says why."""


def number(summary: Mapping[str, object], key: str) -> float:
    value = summary.get(key)
    if not isinstance(value, (int, float)):
        raise BenchError(f"the summary of the print has no number '{key}'")
    return float(value)


def run_print(config: Path, gcode: Path, summary: Path, extra: Sequence[str]) -> Run:
    """Prints `gcode` in a process of its own and measures it; start-up counts as wall time."""
    command = [sys.executable, str(ROOT / "scripts" / "simulate.py"), str(config), str(gcode)]
    command += ["--summary", str(summary), *extra]
    summary.unlink(missing_ok=True)
    start = time.monotonic()
    child = subprocess.Popen(command)
    # wait4 and not Popen.wait: it also tells what the child used
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    wall_s = time.monotonic() - start
    if child.returncode != 0:
        raise BenchError(f"the print ended with status {child.returncode}")
    facts = json.loads(summary.read_text(encoding="utf-8"))
    return Run(wall_s, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6, facts)


def verdict(good: bool) -> str:
    return "[green]met[/]" if good else "[bold red]missed[/]"


def show(gcode: Path, run: Run) -> None:
    table = Table(box=None, show_header=False, padding=(0, 3, 0, 0))
    size_mb = gcode.stat().st_size / 1e6
    table.add_row("file", f"{gcode.name}, {size_mb:.2f} MB")
    table.add_row("simulated time", f"{run.simulated_s:,.1f} s")
    table.add_row("wall time, start-up included", f"{run.wall_s:,.1f} s")
    table.add_row("processor time", f"{run.cpu_s:,.1f} s")
    table.add_row(
        "ratio to real time", f"{run.ratio:.1f}", f"limit {MIN_RATIO:.0f}", verdict(run.ratio >= MIN_RATIO)
    )
    table.add_row(
        "peak memory",
        f"{run.peak_mb:.0f} MB",
        f"limit {MAX_MEMORY_MB:.0f} MB",
        verdict(run.peak_mb <= MAX_MEMORY_MB),
    )
    moves = number(run.summary, "moves")
    table.add_row("moves", f"{moves:,.0f}", f"{moves / run.wall_s:,.0f} a wall second")
    for stage, seconds in stages(run.summary):
        table.add_row(f"  of which {stage}", f"{seconds:,.1f} s", f"{100.0 * seconds / run.wall_s:.0f} %")
    Console(highlight=False).print(table)


def stages(summary: Mapping[str, object]) -> list[tuple[str, float]]:
    """Wall seconds by stage of the simulation, if the summary tells them, greatest first."""
    told = summary.get("stages_s")
    if not isinstance(told, Mapping):
        return []
    named = [(str(k), float(v)) for k, v in told.items() if isinstance(v, (int, float))]
    return sorted(named, key=lambda item: -item[1])


def parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Measure a closed-loop simulated print.")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench", help="folder for the results")
    parser.add_argument(
        "--quick", action="store_true", help="print the small sample instead of the large one"
    )
    parser.add_argument("--config", type=Path, default=ROOT / "config" / "sim-induction.cfg")
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.OPTION=VALUE", dest="overrides"
    )
    return parser.parse_args(argv)


def main(argv: Sequence[str]) -> int:
    options = parse(argv)
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    try:
        gcode = sample_path("cubhelix" if options.quick else "benchy")
        extra = [word for override in options.overrides for word in ("--set", override)]
        run = run_print(options.config, gcode, out / "summary.json", extra)
        show(gcode, run)
    except (BenchError, SampleMissing) as e:
        print(f"bench: {e}", file=sys.stderr)
        return 2
    return 0 if run.ratio >= MIN_RATIO and run.peak_mb <= MAX_MEMORY_MB else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
