#!/usr/bin/env python3
"""Does a long print leak? A part printed over and over by the whole stack in closed loop (`make soak`; HOURS=10).

Host, firmware, heaters and the world share one process and simulated time, so its resident memory is that of the host
and of the models. It is noted once in STEP simulated minutes; what it grows by an hour after the first WARM_UP_S is the
result, and the Python objects that became more are named.
"""

from __future__ import annotations

import harness

import argparse
import collections
import gc
import math
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from simulation.runner import PRINTED, Progress, RunOptions, Simulation

WARM_UP_S = 1800.0  # look-up windows, statistics and the allocator's free lists are full by then
STEP_S = 300.0
# Ten hours may take so much more than the first half (MB per simulated hour): a list that grows by one small object
# at each of 50 moves a second would take 10.
GROWTH_MAX_MB_PER_H = 0.25
NAMED = 8
RADIUS_MM, CHORDS, SPEED_MM_S, RINGS_PER_LAYER = 30.0, 48, 30.0, 20


def part(hours: float) -> Iterator[str]:
    """Lines of a print that lasts a little longer: rings of short chords, retracts, fan and temperature changes."""
    yield "M140 S60\nM104 S210\nG28\nM190 S60\nM109 S210\nM83\nG1 Z0.2 F600\nG1 X60 Y90 F6000\n"
    chord_mm = 2.0 * RADIUS_MM * math.sin(math.pi / CHORDS)
    rings = math.ceil(1.05 * hours * 3600.0 / (CHORDS * chord_mm / SPEED_MM_S))
    for ring in range(rings):
        if ring % RINGS_PER_LAYER == 0:
            layer = ring // RINGS_PER_LAYER
            yield f"M106 S{layer % 2 * 128}\nM104 S{210 + layer % 3}\nG1 E-0.8 F1800\n"
            yield f"G1 Z{0.2 * (1 + layer % 500):.1f} F600\nG1 E0.8 F1800\n"
        for k in range(1, CHORDS + 1):
            angle = 2.0 * math.pi * k / CHORDS
            x, y = 90.0 - RADIUS_MM * math.cos(angle), 90.0 + RADIUS_MM * math.sin(angle)
            yield f"G1 X{x:.3f} Y{y:.3f} E{0.03 * chord_mm:.4f} F{60.0 * SPEED_MM_S:.0f}\n"


class Soak:
    """Looks at the memory while the print goes on."""

    def __init__(self) -> None:
        self.rows: list[tuple[float, float]] = []  # simulated s, MB
        self.begin: collections.Counter[str] = collections.Counter()
        self.end: collections.Counter[str] = collections.Counter()
        self._next_s = 0.0
        self._wall_s = time.monotonic()

    @staticmethod
    def _count() -> collections.Counter[str]:
        gc.collect()
        gc.unfreeze()
        counts = collections.Counter(type(thing).__qualname__ for thing in gc.get_objects())
        gc.freeze()
        return counts

    def look(self, progress: Progress) -> None:
        now_s = progress.simulated_s
        if now_s < self._next_s:
            return
        self._next_s = now_s + STEP_S
        self.end = self._count()
        if now_s >= WARM_UP_S and not self.begin:
            self.begin = self.end
        self.rows.append((now_s, harness.resident_mb()))
        wall_s = time.monotonic() - self._wall_s
        print(f"{now_s / 3600.0:7.2f} h  {self.rows[-1][1]:7.2f} MB  {sum(self.end.values())} objects"
              f"  ({now_s / wall_s:.0f} x real time)", flush=True)  # fmt: skip

    def growth_mb_per_h(self) -> float:
        """Least squares over what came after the warm-up."""
        rows = [(t / 3600.0, mb) for t, mb in self.rows if t >= WARM_UP_S]
        if len(rows) < 3:
            return math.nan
        mean_t, mean_mb = (sum(column) / len(rows) for column in zip(*rows, strict=True))
        return sum((t - mean_t) * (mb - mean_mb) for t, mb in rows) / sum((t - mean_t) ** 2 for t, _ in rows)


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    soak = Soak()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "part.gcode"
        with path.open("w") as file:
            file.writelines(part(options.hours))
        until_s = options.hours * 3600.0
        outcome = Simulation(RunOptions(options.config, path, until_s=until_s, on_progress=soak.look)).run()
    if outcome.status != PRINTED:
        raise harness.BenchError(f"the print ended: {outcome.reason}")
    more = (soak.end - soak.begin).most_common(NAMED)
    print("objects that became more: " + (", ".join(f"{name} +{n}" for name, n in more) or "none"))
    growth = soak.growth_mb_per_h()
    print(f"{growth:+.3f} MB per simulated hour")
    report.at_most("MB per simulated hour", growth, GROWTH_MAX_MB_PER_H, 3)
    report.figures |= {"growth_mb_per_h": growth, "memory_mb": soak.rows}


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__)
    parser.add_argument("--config", type=Path, default=harness.SAMPLE_CONFIG)
    parser.add_argument("--hours", type=float, default=10.0, help="of simulated time (default: 10)")
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
