#!/usr/bin/env python3
"""What the temperature plan does for welds and how well the nozzle follows it, on three unlike sliced files.

    scripts/bench/bench_plan.py [--seconds 450] [--out out/bench/plan] [--steps]

    whole file, offline        interface temperature along the path, planned against one fixed temperature at the
                               file's own speed; once more as PC without an enclosure, where one fixed temperature
                               does not always bond
    the first --seconds of it  printed on the simulated machine in closed loop: the melt that leaves the plant's nozzle,
                               planned, with the same targets set at the borders (no preview), and what one fixed
                               target would give on a nozzle that holds it without fail
    steps                      15 degC every 1.5 s at constant flow: planned against set at the border, on nozzles
                               and filaments that are not what the config says, before and after MODEL_CALIBRATE with
                               FLOW

Melt of the plant at the flow of the moment, weighted with it. "against the plan": the melt that the planned nozzle
temperature gives at that flow. "against wanted": wanted and extruded melt, both averaged over 0.5 s, since no nozzle
follows the flow of single corners.
"""

from __future__ import annotations

import harness  # isort: skip

import argparse
import math
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import bench_plan_cost
import plan_temperature
from extras import temperature_plan
from simulation import plan_offline
from simulation.report import plan as plan_report

FILES = {  # kind, file of pyGCodeDecode's examples
    "Benchy": "benchy.gcode",
    "thin tower, tiny layers": "cubhelix.gcode",
    "large and flat, long layers": "brace.gcode",
}
# The files are sliced for PLA; what is printed here is ABS, with the targets of ABS.
SECTION = {"material": "ABS", "bed_temp": "100", "chamber_temp": "40"}
NOZZLE_C, BED_C = 245, 100
HARD_SECTION = {"material": "PC", "bed_temp": "100", "chamber_temp": "25"}
HARD_NOZZLE_C = 265
UA_W_K, HEAT_MJ_M3K, INLET_C = 0.0276, 2.1, 25.0  # of the reference plant
MIN_FLOW_MM3_S = 0.3
AVERAGE_S = 0.5
STEP_C, STEP_S, STEPS = 15.0, 1.5, 14
STEP_SEEDS = (1, 2, 3, 4, 5, 6, 7, 8)
CALIBRATE = "MODEL_CALIBRATE HEATER=extruder FLOW=15 WAIT=1\n"
Table = dict[str, Any]


@dataclass(frozen=True)
class Tracking:
    """Errors of the extruded melt, degC, flow weighted."""

    rms_plan_c: float
    within_3_plan: float
    rms_wanted_c: float
    within_3_wanted: float


def with_targets(source: Path, folder: Path, nozzle_c: int) -> Path:
    """The file with other targets; nothing waits for the bed."""
    target = folder / source.name
    folder.mkdir(parents=True, exist_ok=True)
    text = source.read_text(encoding="utf-8", errors="replace")
    text = re.sub(r"(?m)^(M10[49])\b[^;\n]*S[1-9][0-9.]*.*", rf"\1 S{nozzle_c}", text)
    text = re.sub(r"(?m)^M1[49]0\b[^;\n]*S[1-9][0-9.]*.*", f"M140 S{BED_C}", text)
    target.write_text(text, encoding="utf-8")
    return target


def offline(
    path: Path, section: dict[str, str], base_c: float
) -> tuple[plan_offline.OfflinePlan, Table, float]:
    """(plan, its figures, µs of processor time a move that planning takes in a printer)."""
    config = bench_plan_cost.sample_config(section)
    settings = temperature_plan.read_settings(config)
    nozzle = plan_temperature.limits_of("induction", config, settings)
    printer = path.with_suffix(".cfg")
    printer.write_text(bench_plan_cost.WIDE_CONFIG)

    def run(settings: temperature_plan.Settings) -> plan_offline.OfflinePlan:
        return plan_offline.OfflineRun(settings, nozzle, base_c).run(printer, path)

    found, plain, known = plan_offline.plan_whole(settings, run)
    figures = plan_report.figures(found, settings.material, plain.summary)
    figures["interface_wanted_c"] = known.options.interface_c
    figures["duration_fixed_s"] = round(plain.duration_s, 1)
    return found, figures, bench_plan_cost.cost_us(path)


def simulate(
    gcode: Path, folder: Path, name: str, seconds: float, options: dict[str, str], more: str = ""
) -> Table:
    """One closed-loop run; its trace, and the rows of the plan. `more`: further lines of the config."""
    section = "[temperature_plan]\n" + "".join(f"{k}: {v}\n" for k, v in {**SECTION, **options}.items())
    record = folder / f"{name}-plan.csv"
    config, trace = folder / f"{name}.cfg", folder / f"{name}.csv"
    config.write_text(f"{bench_plan_cost.WIDE_CONFIG}{section}record: {record}\n{more}")
    harness.program("scripts/simulate.py", config, gcode, "--trace", trace, "--until", seconds)
    read = [np.genfromtxt(path, delimiter=",", names=True) for path in (trace, record)]
    return {"trace": read[0], "plan": read[1]}


def clock_offset_s(run: Table) -> float:
    """Print time less time of the trace: where planned and true nozzle temperature agree best."""
    trace, plan = run["trace"], run["plan"]
    middle = 0.5 * (plan["start_s"] + plan["end_s"])

    def off(shift_s: float) -> float:
        return float(
            np.mean((np.interp(middle - shift_s, trace["t_s"], trace["true_c"]) - plan["wall_c"]) ** 2)
        )

    return min(np.arange(-0.5, 0.5, 0.01), key=off)


def first_flow_s(run: Table) -> float:
    """When the first road begins, time of the trace."""
    trace = run["trace"]
    return float(trace["t_s"][np.argmax(trace["flow_mm3_s"] > 1.0)])


def tracking(run: Table, plan: Any, offset_s: float, fixed_c: float | None = None) -> Tracking:
    """The melt of `run` against a plan's rows; `fixed_c`: that of a nozzle which holds it, at the run's flow."""
    trace = run["trace"]
    times = trace["t_s"] + offset_s
    row = np.searchsorted(plan["start_s"], times, side="right") - 1
    flow = trace["flow_mm3_s"]
    flowing = (row >= 0) & (flow > MIN_FLOW_MM3_S)
    row = np.clip(row, 0, None)
    flowing &= times < plan["end_s"][row]
    row, weight, melt = row[flowing], flow[flowing], trace["melt_c"][flowing]
    if fixed_c is not None:
        melt = INLET_C - (fixed_c - INLET_C) * np.expm1(-UA_W_K / (1e-3 * HEAT_MJ_M3K * weight))
    share = -np.expm1(-UA_W_K / (1e-3 * HEAT_MJ_M3K * weight))
    against_plan = melt - (INLET_C + (plan["wall_c"][row] - INLET_C) * share)
    slot = np.floor(times[flowing] / AVERAGE_S).astype(int)
    slot -= slot[0]
    volume = np.bincount(slot, weight)
    held = volume > 0.0
    mean = [np.bincount(slot, weight * v)[held] / volume[held] for v in (melt, plan["wanted_melt_c"][row])]
    against_wanted, volume = mean[0] - mean[1], volume[held]
    return Tracking(
        float(np.sqrt(np.average(against_plan**2, weights=weight))),
        float(np.average(np.abs(against_plan) <= 3.0, weights=weight)),
        float(np.sqrt(np.average(against_wanted**2, weights=volume))),
        float(np.average(np.abs(against_wanted) <= 3.0, weights=volume)),
    )


def compare(
    gcode: Path,
    folder: Path,
    name: str,
    seconds: float,
    options: dict[str, str],
    fixed_c: float,
) -> dict[str, Tracking]:
    """The same path three ways."""
    planned = simulate(gcode, folder, f"{name}-planned", seconds, options)
    offset_s = clock_offset_s(planned)
    border = simulate(gcode, folder, f"{name}-border", seconds, {**options, "preview": "no"})
    plan = planned["plan"]

    def shifted(run: Table) -> float:  # waiting for the first temperature takes another time in each run
        return offset_s + first_flow_s(planned) - first_flow_s(run)

    return {
        "planned": tracking(planned, plan, offset_s),
        "set at the border": tracking(border, plan, shifted(border)),
        "one fixed target": tracking(planned, plan, offset_s, fixed_c),
    }


def steps_gcode() -> str:
    """15 degC up and down every 1.5 s on one straight way: nothing changes but the temperature."""
    feed_mm_s, flow_mm3_s = 8.0, 5.0
    length_mm = feed_mm_s * STEP_S
    filament_mm = flow_mm3_s * STEP_S / (math.pi / 4.0 * 1.75**2)
    lines = [
        "M104 S215",
        "G28",
        "M83",
        "G1 X6 Y40 Z0.3 F6000",
        "M109 S215",
        "G4 P30000",
    ]  # the holder takes 10 s
    for i in range(STEPS):
        lines.append(f"SET_SEGMENT_TEMPERATURE TEMP={200.0 + STEP_C * (i % 2)}")
        lines.append(f"G1 X{6 + length_mm * (i + 1)} E{filament_mm:.5f} F{60 * feed_mm_s:.0f}")
    return "\n".join([*lines, "M400", ""])


def step_errors(run: Table, plan: Any, offset_s: float) -> tuple[float, float, float]:
    """(rms, mean, spread about the mean) of the melt against wanted over whole periods of 3 s, every row, degC."""
    trace, period_s = run["trace"], 2.0 * STEP_S
    times = trace["t_s"] + offset_s
    begin_s = plan["start_s"][0] + period_s
    end_s = begin_s + period_s * math.floor((plan["end_s"][-1] - begin_s - 0.5 * STEP_S) / period_s)
    row = np.clip(np.searchsorted(plan["start_s"], times, side="right") - 1, 0, None)
    inside = (times >= begin_s) & (times < end_s)
    error = (trace["melt_c"] - plan["wanted_melt_c"][row])[inside]
    return float(np.sqrt(np.mean(error**2))), float(np.mean(error)), float(np.std(error))


def step_plants() -> dict[str, dict[str, float]]:
    """Nozzles and filaments by name: parameters of the plant. The exchange alone, then all of it at once."""
    plants = {f"exchange x {e:.1f}": {"melt_ua_w_k": e * UA_W_K} for e in (0.8, 0.9, 1.0, 1.1, 1.2)}
    for seed in STEP_SEEDS:
        off = np.random.default_rng(seed).uniform(-1.0, 1.0, 6)
        plants[f"all at once, seed {seed}"] = {
            "melt_ua_w_k": (1.0 + 0.2 * off[0]) * UA_W_K,
            "melt_heat_mj_m3k": (1.0 + 0.2 * off[1]) * HEAT_MJ_M3K,
            "melt_in_c": INLET_C + 10.0 * off[2],
            "mass_factor": 1.0 + 0.2 * off[3],
            "loss_factor": 1.0 + 0.2 * off[4],
            "efficiency_factor": 1.0 + 0.2 * off[5],
        }
    return plants


def calibrated(folder: Path, plant: str) -> tuple[dict[str, str], float]:
    """(options that MODEL_CALIBRATE finds on a machine with this plant, seconds it takes)."""
    config, gcode, log = folder / "calibrate.cfg", folder / "calibrate.gcode", folder / "calibrate.log"
    config.write_text(f"[include {harness.SAMPLE_CONFIG}]\n{plant}")
    gcode.write_text(CALIBRATE)
    done = harness.program("scripts/simulate.py", config, gcode, "--log", log)
    found = dict(re.findall(r"save_config: set \[induction_heater nozzle\] (\w+) = (.*)", log.read_text()))
    if "melt_exchange" not in found:
        raise harness.BenchError(f"MODEL_CALIBRATE found nothing:\n{plant}\n{done.errors}")
    took = re.search(r"([0-9.]+) s simulated", done.output + done.errors)
    return found, float(took[1]) if took else math.nan


def step_pair(folder: Path, seconds: float, more: str) -> dict[str, tuple[float, float, float]]:
    """step_errors of the steps planned and set at the border."""
    steps, options = folder / "steps.gcode", {"melt_min": "180"}
    runs = [
        simulate(steps, folder, f"steps-{preview}", seconds, {**options, "preview": preview}, more)
        for preview in ("yes", "no")
    ]
    offset_s = clock_offset_s(runs[0])
    shift_s = offset_s + first_flow_s(runs[0]) - first_flow_s(runs[1])
    plan = runs[0]["plan"]
    return {
        "planned": step_errors(runs[0], plan, offset_s),
        "border": step_errors(runs[1], plan, shift_s),
    }


def measure_steps(folder: Path, seconds: float, report: harness.Report) -> None:
    """The steps on nozzles and filaments unlike the config, as configured and calibrated."""
    (folder / "steps.gcode").write_text(steps_gcode())
    table: Table = {}
    rows, ratios = [], []
    for name, plant in step_plants().items():
        nozzle = "[simulator nozzle nozzle]\n" + "".join(f"{k}: {v:.6g}\n" for k, v in plant.items())
        found, took_s = calibrated(folder, nozzle)
        tuned = "[induction_heater nozzle]\n" + "".join(f"{k}: {v}\n" for k, v in found.items())
        table[name] = {"calibration_s": took_s, "plant": plant, "found": found}
        for when, more in (("before", nozzle), ("after", nozzle + tuned)):
            pair = step_pair(folder, seconds, more)
            ratio = pair["planned"][0] / pair["border"][0]
            table[name][when] = {**pair, "ratio": ratio}
            rows.append(
                (name, when, *(f"{value:.2f}" for three in pair.values() for value in three), f"{ratio:.2f}")
            )
        ratios.append(ratio)
    ours, border = (f"{way}: {{}}".format for way in ("planned", "border"))
    names = ("rms", "mean", "about it")
    heads = ("15 C every 1.5 s", "calibration", *map(ours, names), *map(border, names), "ratio")
    report.table("Error of the melt, C", heads, rows, 2)
    report.figures["15 C every 1.5 s"] = table
    print(
        f"after calibration: {sum(r < 0.5 for r in ratios)} of {len(ratios)} below 0.5, largest {max(ratios):.2f}"
    )


def offline_row(kind: str, found: Table, us: float) -> tuple[str, ...]:
    low, _, high = found["interface_5_50_95_c"]
    low_fixed, _, high_fixed = found["interface_5_50_95_fixed_c"]
    return (
        kind,
        f"{low:.0f}..{high:.0f}",
        f"{found['spread_c']:.1f}",
        f"{low_fixed:.0f}..{high_fixed:.0f}",
        f"{found['spread_fixed_c']:.1f}",
        f"{found['spread_c'] / found['spread_fixed_c']:.2f}",
        *(f"{1 - found[key]:.3%}" for key in ("bonded_share", "bonded_share_fixed")),
        f"{found['min_speed_factor']:.2f}",
        f"{found['duration_s'] / found['duration_fixed_s'] - 1.0:.1%}",
        f"{us:.1f}",
    )


OFFLINE_HEADS = (
    "whole file, offline", "interface 5..95 %, C", "spread", "fixed, C", "spread", "ratio", "below bonding", "fixed",
    "slowest", "longer", "us/move",
)  # fmt: skip
TRACKING_HEADS = ("closed loop", "run", "rms to plan, C", "<= 3 C", "rms to wanted, C", "<= 3 C")


def measure_files(folder: Path, seconds: float, report: harness.Report) -> None:
    """Each file offline and in closed loop."""
    rows = []
    for kind, name in FILES.items():
        path = with_targets(bench_plan_cost.data_file(name), folder, NOZZLE_C)
        _, figures, us = offline(path, SECTION, NOZZLE_C)
        hard = with_targets(bench_plan_cost.data_file(name), folder / "pc", HARD_NOZZLE_C)
        _, hard_figures, _ = offline(hard, HARD_SECTION, HARD_NOZZLE_C)
        report.figures[kind] = {"offline": figures, "planning_us": us, "offline, PC": hard_figures}
        rows += [offline_row(f"{kind}, ABS", figures, us), offline_row(f"{kind}, PC", hard_figures, us)]
    report.table("", OFFLINE_HEADS, rows)
    rows = []
    for kind, name in FILES.items():
        path = folder / name
        extra = {"interface_temp": str(report.figures[kind]["offline"]["interface_wanted_c"])}
        runs = compare(path, folder, path.stem, seconds, extra, NOZZLE_C)
        report.figures[kind]["closed loop"] = runs
        for run, t in runs.items():
            to_plan = f"{t.rms_plan_c:.2f}", f"{t.within_3_plan:.1%}"
            rows.append((kind, run, *to_plan, f"{t.rms_wanted_c:.2f}", f"{t.within_3_wanted:.1%}"))
    report.table("Extruded melt", TRACKING_HEADS, rows, 2)


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    options.out.mkdir(parents=True, exist_ok=True)
    if not options.steps:
        measure_files(options.out, options.seconds, report)
    measure_steps(options.out, options.seconds, report)


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__)
    parser.add_argument("--seconds", type=float, default=450.0, help="printed in closed loop of each file")
    parser.add_argument("--out", type=Path, default=harness.ROOT / "out" / "bench" / "plan")
    parser.add_argument("--steps", action="store_true", help="nothing but the steps")
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
