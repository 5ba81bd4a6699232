#!/usr/bin/env python3
"""How well the thermometer knows the true skin temperature at print conditions, beside the published chain.

    scripts/bench/bench_thermometer.py [--seconds 6] [--json OUT]

The closed loop (scripts/bench/rigs/induction_rig.py: the C plant, block sums, link with delay and jitter) holds a
temperature while extrusion goes on and off and the phase changes with every control step. Laws are fitted to a sweep
of the same plant, as INDUCTION_CALIBRATE does. The rig's link is a bad one, 3 to 8 ms one way. How old a value is on
the host is therefore measured a second time where the product's own link is: in a simulated print through 250 kBaud,
bytes one after the other beside the stepper commands.
"""

from __future__ import annotations

import harness  # isort: skip

import argparse
import csv
import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import published_chain
from induction_rig import Plant, Rig, default_parameters
from thermal.identification import fit_sensing
from thermal.records import SampleBlock, TempEstimate
from thermal.sensing import features, laws

TARGET_C = 270.0
FLOWS_MM3_S = (60.0, 0.0, 50.0, 60.0)
FAN = 1.0  # with these flows 5 % power on average at 270 degC: the conditions the promise names
SWEEP_PERCENT = (0.2, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100)
# (rms, max) in degC: what the product promises for each size of an LSB
LIMITS = {1.0: (0.3, 1.5), 6.4: (0.5, 3.0)}
LATENCY_MAX_S, INTERVAL_MAX_S = 0.010, 0.002


@dataclass(frozen=True)
class Figures:
    """One chain at one LSB size; errors in degC against the skin at the samples' centre."""

    chain: str
    units_per_lsb: float
    rms_c: float
    max_c: float
    interval_ms: float  # mean time between values
    latency_ms: float  # mean, centre of the samples to the value on the host
    latency_max_ms: float
    power_percent: float
    values: int


def sweep(**plant: float) -> fit_sensing.Points:
    """Errors of a held nozzle over temperature and power."""
    rows = []
    scale = plant.get("units_per_lsb", 1.0)
    for percent in SWEEP_PERCENT:
        phase = round(float(fit_sensing.ticks_of_power(np.array(percent / 100))))
        for temp in np.arange(25.0, 401.0, 25.0):
            nozzle = Plant(1, "reference", **{**plant, "start_c": float(temp), "heat_w": 0.0})
            nozzle.set_phase(phase)
            for _ in range(4):
                nozzle.run(32)
            mean = np.mean([nozzle.run(32).mean() for _ in range(64)])
            rows.append((nozzle.read().skin_c, phase, (mean - 256.0) * scale))
    return fit_sensing.Points(*(np.array(column, dtype=float) for column in zip(*rows, strict=True)))


class Recorder:
    """Collects both chains' values while a rig runs."""

    def __init__(self, front: features.FeatureParameters, paper_laws: dict[str, laws.Law]) -> None:
        self.ours: list[tuple[float, float, float]] = []  # (time of the value, degC, arrival)
        self.paper: dict[str, list[tuple[float, float, float]]] = {name: [] for name in paper_laws}
        self._chains = {
            name: (published_chain.PaperParameters(law, front), published_chain.PaperState())
            for name, law in paper_laws.items()
        }

    def __call__(self, block: SampleBlock, found: TempEstimate | None, now_s: float) -> None:
        if found is not None:
            self.ours.append((found.time_s, found.temp_c, now_s))
        for name, (parameters, state) in self._chains.items():
            value = published_chain.paper_step(parameters, state, block)
            if value is not None and not np.isnan(value[1]):
                self.paper[name].append((*value, now_s))


def figures(
    name: str,
    units: float,
    rows: list[tuple[float, float, float]],
    trace: dict[str, np.ndarray],
    from_s: float,
) -> Figures:
    time_s, temp_c, arrival_s = np.array(rows).T
    late = time_s > from_s
    time_s, temp_c, arrival_s = time_s[late], temp_c[late], arrival_s[late]
    error = temp_c - np.interp(time_s, trace["t_s"], trace["skin_c"])
    delay = arrival_s - time_s
    share = (trace["phase"][trace["t_s"] > from_s] / 45000) ** 2
    return Figures(
        name,
        units,
        float(np.sqrt(np.mean(error**2))),
        float(np.abs(error).max()),
        1e3 * float(np.mean(np.diff(time_s))),
        1e3 * float(delay.mean()),
        1e3 * float(delay.max()),
        100.0 * float(share.mean()),
        int(error.size),
    )


def run(units: float, seconds: float, seed: int = 3) -> list[Figures]:
    """Both chains at one LSB size."""
    result = fit_sensing.fit_tank(sweep(units_per_lsb=units))
    law = laws.law_of("tank", result.values(), result.residual_sd)
    front = features.FeatureParameters(units_per_lsb=units)
    rig = Rig(Plant(seed, units_per_lsb=units), default_parameters(law=law, front=front), seed)
    recorder = Recorder(front, {"paper, eq 5": laws.Eq5Law(), "paper, calibrated law": law})
    rig.loop.listeners.append(recorder)
    rig.run(0.6)
    rig.set_target(TARGET_C)
    rig.run(2.5)
    start_s = rig.now_s
    for flow in FLOWS_MM3_S:
        rig.plant.set_inputs(flow, FAN)
        rig.run(seconds / len(FLOWS_MM3_S))
    trace = rig.trace.arrays()
    out = [figures("ferrite", units, recorder.ours, trace, start_s)]
    return out + [figures(name, units, rows, trace, start_s) for name, rows in recorder.paper.items()]


# Heat, then lines at 20 mm3/s back and forth while blocks are written: the link carries steps too.
STACK_GCODE = """
M104 S250
G28
M83
G1 X60 Y60 Z0.3 F6000
M109 S250
{start}
INDUCTION_DUMP HEATER=nozzle FILE={dump} DURATION={seconds}
{lines}
M400
"""
LINES_MM3_S = 20.0
START_LINES = 10  # of half a second: more than the look-ahead queue holds


def stack_latency_ms(seconds: float) -> tuple[float, float]:
    """(mean, max) age of a block's centre when the host takes it, ms, in a print on config/sim-induction.cfg.

    The dump begins when the look-ahead queue is full, so that the print is under way.
    """
    feed_mm_s, length_mm = 100.0, 50.0
    filament_mm = LINES_MM3_S * length_mm / feed_mm_s / 2.405  # 1.75 mm filament: 2.405 mm2
    lines = [
        f"G1 X{60 + length_mm * (i % 2 == 0)} E{filament_mm:.4f} F{60 * feed_mm_s:.0f}"
        for i in range(START_LINES + math.ceil(seconds * feed_mm_s / length_mm))
    ]
    start, lines = lines[:START_LINES], lines[START_LINES:]
    with tempfile.TemporaryDirectory() as folder:
        dump, part = Path(folder) / "dump.csv", Path(folder) / "part.gcode"
        words = {"start": "\n".join(start), "lines": "\n".join(lines)}
        part.write_text(STACK_GCODE.format(dump=dump.name, seconds=seconds, **words))
        # dumps lie beside the log
        harness.program("scripts/simulate.py", harness.SAMPLE_CONFIG, part, "--log", Path(folder) / "log")
        with dump.open(newline="") as stream:
            ages = [1e3 * float(row["latency"]) for row in csv.DictReader(stream)]
    return sum(ages) / len(ages), max(ages)


def judge(row: Figures, report: harness.Report) -> None:
    """The limits of our chain."""
    rms_c, max_c = LIMITS[row.units_per_lsb]
    at = f"at {row.units_per_lsb} units/LSB:"
    report.at_most(f"{at} rms", row.rms_c, rms_c)
    report.at_most(f"{at} max", row.max_c, max_c)
    report.at_most(f"{at} interval ms", row.interval_ms, 1e3 * INTERVAL_MAX_S)


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    options.seconds /= 3.0 if options.quick else 1.0
    rows = [row for units in LIMITS for row in run(units, options.seconds)]
    report.figures["accuracy"] = rows
    for row in rows:
        if row.chain == "ferrite":
            judge(row, report)
    heads = ("chain", "units/LSB", "rms C", "max C", "every ms", "latency ms", "max", "power %")
    texts = (
        (
            row.chain,
            row.units_per_lsb,
            *(f"{value:.2f}" for value in (row.rms_c, row.max_c, row.interval_ms, row.latency_ms)),
            *(f"{value:.1f}" for value in (row.latency_max_ms, row.power_percent)),
        )
        for row in rows
    )
    report.table("published: +-3 C in 20 ms (Oskolkov 2021, abstract)", heads, texts)
    mean_ms, max_ms = stack_latency_ms(options.seconds)
    report.figures["print_latency_ms"] = {"mean": mean_ms, "max": max_ms}
    print(f"latency in a print through 250 kBaud: mean {mean_ms:.1f} ms, max {max_ms:.1f} ms")
    report.at_most("latency ms in a print", max_ms, 1e3 * LATENCY_MAX_S, 1)


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__, "a third of the time")
    parser.add_argument("--seconds", type=float, default=6.0, help="simulated time per LSB size")
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
