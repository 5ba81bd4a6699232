#!/usr/bin/env python3
"""Where [print_recovery] would resume a print, at many random instants, compared with the machine.

    scripts/bench/bench_recovery.py [--instants 1000] [--sample cubhelix] [--seed 21] [--json FILE]

One print in virtual time. At each instant the journal is read as a crash would leave it, with the steps of the motors
as the boards count them. Three crashes: host killed (the counts are there), board reset, power lost (they are not).
"""

from __future__ import annotations

import harness

import argparse
import random
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from extras.recovery.journal import Journal
from extras.recovery.path import Refusal
from simulation.runner import RunOptions, Simulation
from simulation.sample_gcode import sample_path

AXES = {"x": "stepper_x", "y": "stepper_y", "z": "stepper_z", "extruder": "extruder"}
FULL_STEP_MM = {"x": 40.0 / 200, "y": 40.0 / 200, "z": 8.0 / 200, "extruder": 7.6 / 200}
INTERVAL_S = 0.5


@dataclass(slots=True)
class Instant:
    """What a crash at this moment would leave: the journal, the motors' steps; and where the axes are."""

    record: dict[str, Any]
    steps: dict[str, int]
    place: dict[str, float]


class Watched(Simulation):
    """Looks at journal and machine at given times."""

    def __init__(self, options: RunOptions, journal: Path, at_s: list[float]) -> None:
        super().__init__(options)
        self.journal, self.at_s = journal, sorted(at_s)
        self.instants: list[Instant] = []
        self.outcome: Any = None

    def axis(self, name: str) -> dict[str, Any]:
        assert self.machine is not None
        return self.world.axis(self.machine.axes[name])

    def _before_advance(self, now: float) -> None:
        super()._before_advance(now)
        while self.at_s and now - self.world.start_s >= self.at_s[0]:
            self.at_s.pop(0)
            axes = {name: self.axis(name) for name in AXES}
            steps = {AXES[n]: int(a["steps_forward"] - a["steps_backward"]) for n, a in axes.items()}
            place = {name: a["position_mm"] for name, a in axes.items()}
            self.instants.append(Instant(Journal(str(self.journal)).read(), steps, place))


def options(part: Path, journal: Path, *faults: str) -> RunOptions:
    """A print of `part` with [print_recovery]."""
    values = {"filename": str(journal), "interval": str(INTERVAL_S), "z_stays": "True"}
    overrides = tuple(("print_recovery", name, value) for name, value in values.items())
    return RunOptions(harness.SAMPLE_CONFIG, part, overrides=overrides, faults=faults)


def off_mm(point: tuple[float, ...], instant: Instant) -> dict[str, float]:
    """How far the point is from the machine, axis by axis."""
    return {name: abs(point[number] - instant.place[name]) for number, name in enumerate(AXES)}


def judge(recovery: Any, instant: Instant, has_steps: bool) -> str:
    """'resumed', 'wrong', or why it is refused."""
    if not instant.record:
        return "refused: no record (no motion yet, or the end)"
    record = {**instant.record, "steps": instant.steps} if has_steps else instant.record
    try:
        place = recovery.find(record)
    except Refusal as e:
        return f"refused: {e}"
    right = all(off < FULL_STEP_MM[name] for name, off in off_mm(place.point, instant).items())
    return "resumed" if right else "wrong"


def bench(given: argparse.Namespace, report: harness.Report) -> None:
    part, chance = sample_path(given.sample), random.Random(given.seed)
    with tempfile.TemporaryDirectory() as folder:
        plain = Simulation(options(part, Path(folder) / "plain"))
        plain.run()
        end_s = plain.facts.simulated_s
        at_s = [chance.uniform(0.0, end_s) for _ in range(given.instants)]
        watched = Watched(options(part, Path(folder) / "recovery"), Path(folder) / "recovery", at_s)
        watched.run()
        recovery = watched.printer.lookup_object("print_recovery")
        bytes_per_minute = recovery.get_status(0.0)["bytes_per_minute"]
        crashes = {"host killed": True, "board reset": False, "power lost": False}
        counts = {
            crash: Counter(judge(recovery, instant, has_steps) for instant in watched.instants)
            for crash, has_steps in crashes.items()
        }
    rows = [(crash, result, number) for crash, found in counts.items() for result, number in found.items()]
    report.table(
        f"{len(watched.instants)} instants of {part.name}", ("crash", "result", "instants"), rows, left=2
    )
    report.figures = {"counts": counts, "bytes_per_minute": bytes_per_minute}
    report.table("", (), [("bytes a minute", round(bytes_per_minute), "")])
    for crash, found in counts.items():
        if found["wrong"]:
            report.missed.append(f"{crash}: {found['wrong']} places wrong")


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__)
    parser.add_argument("--instants", type=int, default=1000)
    parser.add_argument("--sample", default="cubhelix", help="a file of the sample package")
    parser.add_argument("--seed", type=int, default=21)
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
