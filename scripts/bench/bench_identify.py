#!/usr/bin/env python3
"""How well identify finds plants that nobody showed it.

    scripts/bench/bench_identify.py [--plants 20] [--first 1] [--out out/bench/identify] [--quick] [--json FILE]

Each hidden plant is drawn at random, prints the beginning of a sliced file on the simulated machine with the sensing
law of another plant, and is recorded. The table compares what was found with what was drawn. Then the section that was
found prints the same file in closed loop: `again` is the difference of its trace to the hidden plant's, both of the
true skin.
"""

from __future__ import annotations

import harness
from harness import ROOT, SAMPLE_CONFIG

import argparse
import math
import random
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import configtext
from simulation.identify import fit, recording, report
from simulation.sample_gcode import sample_path

LINES = 330  # of the sample: 25 s of printing
REFUSED = 3  # the printer shut down: its law cannot be that plant's
# Of all hidden plants.
TRUE = {"fan_w_k": 5e-3, "heat_exponent": 1.5}
NAMES = (*(f.name for f in fit.FREE), "noise_lsb")


@dataclass(slots=True)
class Result:
    """One hidden plant. `z`: (found - true)/standard error."""

    seed: int
    rms_c: float
    again_c: float
    values: dict[str, tuple[float, float, float]] = field(default_factory=dict)  # true, found, standard error
    unknown: list[str] = field(default_factory=list)

    def z(self, name: str) -> float:
        true, found, sigma = self.values[name]
        return (found - true) / sigma


def hidden(seed: int) -> dict[str, float]:
    """Parameters of the plant's config that identify has to find."""
    uniform = random.Random(seed).uniform
    ambient_c = uniform(10.0, 35.0)
    return {
        **{name: uniform(0.7, 1.3) for name in ("mass_factor", "loss_factor", "efficiency_factor")},
        "melt_ua_w_k": 27.6e-3 * uniform(0.7, 1.3),
        "second_j_k": 0.572 * uniform(0.7, 1.3),
        "supply_v": 24.0 * uniform(0.97, 1.03),
        "c1_factor": 1.0 + uniform(-2e-4, 2e-4),  # 3 degC of the reading
        "noise_lsb": 0.3 * 10.0 ** uniform(0.0, 1.0),
        "ambient_c": ambient_c,
        "start_c": ambient_c,
    }


def sample(lines: int = LINES) -> str:
    """The beginning of a sliced file, then cooling. Without waits for bed and nozzle two runs keep the same times."""
    text = sample_path("cubhelix").read_text().splitlines()
    kept = [line for line in text if not line.startswith(("M109 R", "M140", "M190", "G29"))]
    kept = ["G4 P6000" if line.startswith("M109") else line for line in kept]
    return "\n".join([*kept[:lines], "M400", "M104 S0", "M107", "G4 P8000"]) + "\n"


def printed(folder: Path, gcode: str, settings: Mapping[str, float], seed: int, *more: str) -> bool:
    """Print into an empty folder: record.run and trace.csv. False: the printer shut down."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.run"):
        old.unlink()
    (folder / "part.gcode").write_text(gcode)
    command = [
        sys.executable,
        str(ROOT / "scripts" / "simulate.py"),
        str(SAMPLE_CONFIG),
        str(folder / "part.gcode"),
    ]
    command += ["--seed", str(seed), "--log", str(folder / "host.log"), "--trace", str(folder / "trace.csv")]
    overrides = [*more, "induction_heater nozzle.record_file=record.run"]
    overrides += [f"simulator nozzle nozzle.{name}={value!r}" for name, value in settings.items()]
    for text in overrides:
        command += ["--set", text]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, REFUSED):
        raise harness.BenchError(done.stderr)
    return done.returncode == 0


def section_options(text: str) -> dict[str, float]:
    """The numbers of a written section, as a host reads it."""
    data = configtext.ConfigData()
    configtext.ConfigParser(data).parse_text(text, "the section")
    (section,) = data.sections.values()
    return {name: float(o.value) for name, o in section.options.items() if name not in ("preset", "fan")}


def compare(seed: int, true: Mapping[str, float], run: recording.Recording, found: fit.Fit) -> Result:
    result = Result(seed, report.rms_c(run, found), math.nan)
    for row in found.found:
        if math.isnan(row.sigma):
            result.unknown.append(row.name)
        else:
            result.values[row.name] = ({**TRUE, **true}[row.name], row.value, row.sigma)
    return result


def skin_difference_c(one: Path, other: Path) -> float:
    """rms of the true skin of two traces, at equal times."""
    traces = [np.genfromtxt(path, delimiter=",", names=True) for path in (one, other)]
    rows = min(map(len, traces))
    return float(np.sqrt(np.mean((traces[0]["true_c"][:rows] - traces[1]["true_c"][:rows]) ** 2)))


def examined(folder: Path, seed: int, gcode: str, again: bool = True) -> Result | None:
    """One hidden plant; None: its printer refused the law."""
    true = hidden(seed)
    if not printed(folder / "hidden", gcode, true, seed):
        return None
    run = recording.read(folder / "hidden" / "record.run")
    found = fit.fit(run, {})
    result = compare(seed, true, run, found)
    if again:
        options = section_options(report.section(run, found, "record.run"))
        # The detuning that was found has the error of the MCU's crystal in it.
        if printed(folder / "again", gcode, options, seed, "simulator mcu.clock_ppm=0"):
            traces = (folder / name / "trace.csv" for name in ("hidden", "again"))
            result.again_c = skin_difference_c(*traces)
    return result


def rows(results: list[Result]) -> list[list[str]]:
    """A plant each, and the median standard error in percent."""
    lines = []
    for result in results:
        cells = [f"{result.z(name):+.2f}" if name in result.values else "-" for name in NAMES]
        lines.append([str(result.seed), f"{result.rms_c:.2f}", f"{result.again_c:.2f}", *cells])
    shares = [[r.values[n][2] / abs(r.values[n][1]) for r in results if n in r.values] for n in NAMES]
    medians = [f"{100.0 * float(np.median(s)):.2g} %" if s else "-" for s in shares]
    return [*lines, ["error", "", "", *medians]]


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    gcode, results, refused, seed = sample(), list[Result](), 0, options.first
    while len(results) < (4 if options.quick else options.plants):
        result = examined(options.out / str(seed), seed, gcode)
        seed += 1
        if result is None:
            refused += 1
        else:
            results.append(result)
    found = [abs(r.z(name)) for r in results for name in r.values]
    inside = sum(z <= 2.0 for z in found)
    heads = ("plant", "rms C", "again C", *(name.partition("_")[0] for name in NAMES))
    report.table("found less true, in standard errors", heads, rows(results))
    print(
        f"within two standard errors: {inside} of {len(found)}; plants whose printer refused the law: {refused}"
    )
    report.at_least("share within two standard errors", inside / len(found), 0.9)
    report.at_most("simulated against recorded, C rms,", max(r.rms_c for r in results), 1.0)
    report.figures.update(plants=results, inside=inside, found=len(found), refused=refused)


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__, "four plants")
    parser.add_argument("--plants", type=int, default=20)
    parser.add_argument("--first", type=int, default=1, help="seed of the first plant")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench" / "identify")
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
