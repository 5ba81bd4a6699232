#!/usr/bin/env python3
"""What the temperature plan does for welds, on three unlike sliced files, planned whole and offline.

    scripts/bench/bench_plan.py [--out out/bench/plan]

Interface temperature along the path, planned against one fixed temperature at the file's own speed; once more as PC
without an enclosure, where one fixed temperature does not always bond. How the melt follows the plan in prints is in
the studies config/studies/plan_prints.toml and plan_steps.toml.
"""

from __future__ import annotations

import harness

import argparse
import re
import sys
from pathlib import Path
from typing import Any

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
Table = dict[str, Any]


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


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    """Each file in both materials."""
    rows = []
    for kind, name in FILES.items():
        source = bench_plan_cost.data_file(name)
        _, figures, us = offline(with_targets(source, options.out, NOZZLE_C), SECTION, NOZZLE_C)
        hard = with_targets(source, options.out / "pc", HARD_NOZZLE_C)
        _, hard_figures, _ = offline(hard, HARD_SECTION, HARD_NOZZLE_C)
        report.figures[kind] = {"offline": figures, "planning_us": us, "offline, PC": hard_figures}
        rows += [offline_row(f"{kind}, ABS", figures, us), offline_row(f"{kind}, PC", hard_figures, us)]
    report.table("", OFFLINE_HEADS, rows)


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__)
    parser.add_argument("--out", type=Path, default=harness.ROOT / "out" / "bench" / "plan")
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
