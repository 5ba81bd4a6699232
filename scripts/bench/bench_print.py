#!/usr/bin/env python3
"""Prints the large sample in closed loop and measures speed and memory against their limits (`make bench`).

The print runs as its own process, exactly as a user would run it, without trace and report, so that its peak
memory and its time are those of the printer stack alone. With --quick the small sample is printed.
"""

from __future__ import annotations

import harness

import argparse
import json
import sys
import tempfile
from pathlib import Path

from simulation.sample_gcode import SampleMissing, sample_path

MIN_RATIO = 20.0  # simulated seconds per wall second, on two cores
MAX_MEMORY_MB = 300.0


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    try:
        gcode = sample_path("cubhelix" if options.quick else "benchy")
    except SampleMissing as e:
        raise harness.BenchError(str(e)) from None
    extra = [word for override in options.overrides for word in ("--set", override)]
    with tempfile.TemporaryDirectory() as folder:
        summary = Path(folder) / "summary.json"
        run = harness.program("scripts/simulate.py", options.config, gcode, "--summary", summary, *extra)
        facts = json.loads(summary.read_text(encoding="utf-8"))
    ratio = facts["simulated_s"] / run.wall_s
    report.at_least("simulated time to wall time", ratio, MIN_RATIO, 1)
    report.at_most("peak memory, MB,", run.peak_mb, MAX_MEMORY_MB, 0)
    report.figures |= {"wall_s": run.wall_s, "cpu_s": run.cpu_s, "peak_mb": run.peak_mb, "summary": facts}
    rows = [
        ("file", gcode.name, f"{gcode.stat().st_size / 1e6:.2f} MB"),
        ("simulated time", f"{facts['simulated_s']:,.1f} s", ""),
        ("wall time, start-up included", f"{run.wall_s:,.1f} s", ""),
        ("processor time", f"{run.cpu_s:,.1f} s", ""),
        ("ratio to real time", f"{ratio:.1f}", f"limit {MIN_RATIO:.0f}"),
        ("peak memory", f"{run.peak_mb:.0f} MB", f"limit {MAX_MEMORY_MB:.0f} MB"),
        ("moves", f"{facts['moves']:,.0f}", f"{facts['moves'] / run.wall_s:,.0f} a wall second"),
    ]
    for stage, seconds in sorted(facts.get("stages_s", {}).items(), key=lambda item: -item[1]):
        rows.append((f"  of which {stage}", f"{seconds:,.1f} s", f"{100.0 * seconds / run.wall_s:.0f} %"))
    report.table("", ("", "", ""), rows)


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__, "print the small sample instead of the large one")
    parser.add_argument("--config", type=Path, default=harness.SAMPLE_CONFIG)
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.OPTION=VALUE", dest="overrides"
    )
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
