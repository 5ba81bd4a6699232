#!/usr/bin/env python3
"""Are two batch outputs the same motion? Steps, net position, first and last step of every stepper.

    .venv/bin/python klippy/klippy.py printer.cfg -i part.gcode -o A -d DICT
    scripts/bench/compare_batch.py A.dict A B.dict B

A stepper's name is its step pin. "Same" as batch mode means it: as many steps, ending in the same place, the
last step at the same time, and every step within the tolerance of the other's; the grouping into commands may differ.
With --from-first times count from the first step of each output: a different lead before it does not matter.

Exit status 0 the same, 1 not, 2 bad input.
"""

from __future__ import annotations

import harness

import argparse
import math
import sys
from pathlib import Path

import numpy as np

import motion_plot

Motors = dict[str, motion_plot.Motor]
HEADER = f"{'step pin':>12} {'steps':>19} {'net':>17} {'first, s':>21} {'last, s':>21} {'widest':>11}"


def read(dictionary: Path, output: Path) -> Motors:
    """Step pin → motor, its positions in steps."""
    return {motor.name: motor for motor in motion_plot.read_batch(dictionary, output, {})}


def first_step_s(motors: Motors) -> float:
    return min((float(m.times[0]) for m in motors.values() if len(m.times)), default=0.0)


def widest_s(a: motion_plot.Motor, b: motion_plot.Motor, shift_s: float) -> float:
    """How far apart in time the motors make the same step; nan if they make different ones."""
    if len(a.times) != len(b.times) or not np.array_equal(a.positions, b.positions):
        return math.nan
    return float(np.abs(a.times - b.times - shift_s).max(initial=0.0))


def compare(a: Motors, b: Motors, shift_s: float, tolerance_s: float) -> bool:
    """Print a row for each stepper; True if they agree."""
    print(HEADER)
    same = a.keys() == b.keys()
    for pin in sorted(a.keys() | b.keys()):
        pair = (a.get(pin, motion_plot.Motor(pin, 1.0)), b.get(pin, motion_plot.Motor(pin, 1.0)))
        counts = [len(m.times) for m in pair]
        nets = [int(m.positions[-1]) if len(m.times) else 0 for m in pair]
        firsts = [float(m.times[0]) if len(m.times) else 0.0 for m in pair]
        lasts = [float(m.times[-1]) if len(m.times) else 0.0 for m in pair]
        widest = widest_s(*pair, shift_s)
        print(
            f"{pin.removeprefix('pin '):>12} {counts[0]:9d} {counts[1]:9d} {nets[0]:8d} {nets[1]:8d}"
            f" {firsts[0]:10.6f} {firsts[1]:10.6f} {lasts[0]:10.6f} {lasts[1]:10.6f} {widest * 1e6:8.1f} us"
        )
        apart_s = abs(lasts[0] - lasts[1] - shift_s) if any(counts) else 0.0
        same &= counts[0] == counts[1] and nets[0] == nets[1] and max(widest, apart_s) <= tolerance_s
    return same


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs=4, type=Path, metavar="DICT OUT", help="dictionary and output, twice")
    parser.add_argument("--tolerance", type=float, default=25.0, help="us (default: 25)")
    parser.add_argument("--from-first", action="store_true", help="count times from the first step")
    options = parser.parse_args()
    try:
        a, b = read(*options.files[:2]), read(*options.files[2:])
    except motion_plot.PlotError as e:
        print(f"compare_batch: {e}", file=sys.stderr)
        return 2
    shift_s = first_step_s(a) - first_step_s(b) if options.from_first else 0.0
    same = compare(a, b, shift_s, options.tolerance * 1e-6)
    print("the same motion" if same else "NOT the same motion")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
