#!/usr/bin/env python3
"""Control laws where a comparison cannot be a print: designs of others, a conventional hotend, the host's cost.

    scripts/bench/bench_control.py [--quick]

Our laws on the nozzle are studies: config/studies/control.toml and control_machines.toml. Two designs the field ships
(scripts/bench/rigs/peers.py, from their documentation) run the same programme at the plant itself. All laws run on the
plant of a hotend. The host's cost is measured last, on this machine.
"""

from __future__ import annotations

import harness

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import hotend_bench as hotend
import peers
from control_figures import Result
from induction_rig import Plant, Rig, default_parameters, true_law
from thermal.control.control_api import Schedule
from thermal.control.predictive import MODEL

STEP_COST_US, HOST_SHARE = 100.0, 0.05
WARM_UP_S, HOLD_S = 10.0, 40.0  # of the host, in real time
COLUMNS: tuple[tuple[str, Callable[[Result], str]], ...] = (
    ("settle s", lambda r: f"{r.settle_s:.3f}"),
    ("/ optimal", lambda r: f"{r.settle_ratio:.3f}"),
    ("over", lambda r: f"{r.overshoot_c:.2f}"),
    ("hold", lambda r: f"{r.hold_c:.2f}"),
    ("ripple", lambda r: f"{r.ripple_c:.2f}"),
    ("flow dev", lambda r: f"{r.flow_deviation_c:.2f}"),
    ("flow steady", lambda r: f"{r.flow_steady_c:.2f}"),
    ("+step s", lambda r: f"{r.step_s:.3f}"),
    ("min s", lambda r: f"{r.step_min_s:.3f}"),
)
# In which `model` has to be better than every other law on the hotend; below the floor two figures are alike.
BETTER: tuple[tuple[str, Callable[[Result], float], float], ...] = (
    ("settle beyond optimal", lambda r: r.settle_s - r.optimal_s, 0.002),
    ("overshoot", lambda r: r.overshoot_c, 0.02),
    ("hold error", lambda r: r.hold_c, 0.02),
    ("ripple", lambda r: r.ripple_c, 0.02),
    ("flow deviation", lambda r: r.flow_deviation_c, 0.02),
    ("flow steady", lambda r: r.flow_steady_c, 0.02),
    ("step beyond the minimum", lambda r: r.step_over_s, 0.002),
)


def show(report: harness.Report, title: str, results: Sequence[Result]) -> None:
    heads = ("law", "plant", *(name for name, _ in COLUMNS))
    report.table(
        title, heads, [(r.controller, r.plant, *(text(r) for _, text in COLUMNS)) for r in results], 2
    )
    report.figures[title] = list(results)


def compare_hotends(report: harness.Report) -> None:
    """Every law on the conventional hotend, then `model` on others."""
    ours, *others = results = [hotend.run(law, "hotend") for law in hotend.LAWS]
    show(report, "Conventional hotend, 25 -> 220 degC, flow 0-10-0 mm3/s, +20 degC", results)
    for name, figure, floor in BETTER:
        for other in others:
            text = f"hotend: {other.controller} is better in {name}: {figure(other):.3f}, {figure(ours):.3f}"
            report.require(max(floor, figure(ours)) <= max(floor, figure(other)), text)
    unlike = [hotend.run("model", name) for name in list(hotend.PLANTS)[1:]]
    show(report, "model on hotends unlike its parameters", unlike)


def step_cost_us(printing: bool = False) -> float:
    """Mean time of one step of predictive control while it holds a nozzle, in this process.

    printing: with a flow that changes every 10 ms, so that every step makes a plan of what follows.
    """
    rig = Rig(Plant(5, start_c=25.0), default_parameters(law=true_law()), 5)
    calls: list[tuple[Any, ...]] = []

    def recorded(*args: Any) -> Any:
        calls.append(args)
        return MODEL.step(*args)

    rig.run(0.6)
    rig.set_target(peers.TARGET_C)
    rig.run(2.0)
    law = type(MODEL)(MODEL.name, recorded, MODEL.start, MODEL.follow)
    rig.loop.parameters = replace(rig.loop.parameters, control=replace(rig.loop.parameters.control, law=law))
    if printing:
        times_s = tuple(rig.now_s + 0.01 * i for i in range(200))
        rig.loop.flow = Schedule(times_s, tuple(5.0 + 3.0 * math.sin(i) for i in range(200)))
    rig.run(2.0)
    best = float("inf")
    for _ in range(5):
        start = time.process_time()
        for args in calls:
            MODEL.step(*args)
        best = min(best, (time.process_time() - start) / len(calls))
    return 1e6 * best


def host_share(hold_s: float) -> float:
    """CPU of the host's process a second of holding 250 degC in real time; the world runs in a process of its own.

    NaN if the printer stopped on the way: this computer was too busy to be a printer's.
    """
    with (
        tempfile.TemporaryDirectory() as name,
        harness.printer(Path(name), f"[include {harness.SAMPLE_CONFIG}]") as (client, pid),
    ):
        client.ask("gcode/script", script="M104 S250")
        time.sleep(WARM_UP_S)
        before = harness.cpu_s(pid)
        time.sleep(hold_s)
        share = (harness.cpu_s(pid) - before) / hold_s
        return share if client.ask("info")["state"] == "ready" else math.nan


def measure_cost(quick: bool, report: harness.Report) -> None:
    """Time of a step, share of a core."""
    cost_us, busy_us = step_cost_us(), step_cost_us(printing=True)
    report.figures |= {"step_us": cost_us, "step_printing_us": busy_us}
    report.at_most("us a step of predictive control", cost_us, STEP_COST_US, 0)
    rows = [("model: a step, us", f"{cost_us:.0f}"), ("  while the flow changes", f"{busy_us:.0f}")]
    if not quick:
        share = host_share(HOLD_S)
        report.figures["host_share"] = share if math.isfinite(share) else None
        report.at_most("share of a core of the host", share, HOST_SHARE, 3)
        rows.append(("host, holding one nozzle in real time, % of a core", f"{100 * share:.1f}"))
    report.table("", ("", ""), rows)


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    for preset in peers.POWER_W:
        results = [peers.run(name, preset) for name in peers.PEERS]
        show(
            report,
            f"Peers on the induction nozzle, {preset}, 25 -> 250 degC, flow 0-25-0 mm3/s, +25 degC",
            results,
        )
    compare_hotends(report)
    measure_cost(options.quick, report)


if __name__ == "__main__":
    sys.exit(harness.main(bench, harness.options(__doc__, "no share of a core of the host")))
