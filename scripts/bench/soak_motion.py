#!/usr/bin/env python3
"""Random lists of moves on every machine for as long as you like: each step against the analytic path, every limit.

The short form is test/unit/motion/test_motion_properties.py. A fault names machine and seed:
`--machine NAME --seed N --runs 1` makes it again.
"""

from __future__ import annotations

import harness

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import motion_exact
import motion_limits
import motion_lists
import motion_oracle

LISTS_PER_RUN = 20


def check(name: str, seed: int) -> tuple[Any, list[str]]:
    """(tally, faults) of one run."""
    with tempfile.TemporaryDirectory() as folder:
        gcode = motion_lists.gcode_of(name, seed, LISTS_PER_RUN)
        run = motion_oracle.run_batch(Path(folder), gcode, motion_lists.config_of(name))
        tally = motion_oracle.check_motors(run, seed=seed)
        faults = tally.faults + motion_limits.plan_faults(run)
        if name.replace("-", "_") in motion_exact.LINEAR:
            faults += motion_limits.step_faults(run, seed)[1]
    return tally, faults


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    names = options.machine or list(motion_lists.BOXES)
    end, total, runs = time.monotonic() + options.seconds, motion_oracle.Tally(), 0
    while time.monotonic() < end and not (options.runs and runs >= options.runs):
        name, seed = names[runs % len(names)], options.seed + runs // len(names)
        try:
            tally, faults = check(name, seed)
            total.add(tally)
        except AssertionError as problem:
            faults = [f"refused: {problem}"]
        runs += 1
        report.missed += [f"{name}, seed {seed}: {fault}" for fault in faults[:5]]
    print(
        f"{runs * LISTS_PER_RUN} lists on {len(names)} machines, {total.moves} moves, {total.steps} steps;"
        f" a step at most {total.earliest_s * 1e6:.3f} us before its time, {total.latest_s * 1e6:.3f} us after"
        " (clock ticks)"
    )


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help="stop after this time (default: 600)")
    parser.add_argument(
        "--runs", type=int, default=0, help=f"stop after so many runs of {LISTS_PER_RUN} lists"
    )
    parser.add_argument("--machine", action="append", help="only this one; may be given again")
    parser.add_argument("--seed", type=int, default=1000, help="of the first round")
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
