"""Random lists of moves on every machine for as long as you like: each step against the analytic path, every limit.

The short form is test/unit/motion/test_motion_properties.py. A fault names machine and seed:
`--machine NAME --seed N --runs 1` makes it again.
"""

from __future__ import annotations

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


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=600.0, help="stop after this time (default: 600)")
    parser.add_argument(
        "--runs", type=int, default=0, help=f"stop after so many runs of {LISTS_PER_RUN} lists"
    )
    parser.add_argument("--machine", action="append", help="only this one; may be given again")
    parser.add_argument("--seed", type=int, default=1000, help="of the first round")
    args = parser.parse_args()
    names = args.machine or list(motion_lists.BOXES)
    end, total, runs, bad = time.monotonic() + args.seconds, motion_oracle.Tally(), 0, 0
    while time.monotonic() < end and not (args.runs and runs >= args.runs):
        name, seed = names[runs % len(names)], args.seed + runs // len(names)
        try:
            tally, faults = check(name, seed)
            total.add(tally)
        except AssertionError as problem:
            faults = [f"refused: {problem}"]
        runs += 1
        if faults:
            bad += 1
            print(f"{name}, seed {seed}:", *faults[:5], sep="\n    ", flush=True)
    print(
        f"{runs * LISTS_PER_RUN} lists on {len(names)} machines, {total.moves} moves, {total.steps} steps: "
        f"{bad} runs with faults; a step at most {total.earliest_s * 1e6:.3f} us before its time, "
        f"{total.latest_s * 1e6:.3f} us after (clock ticks)"
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
