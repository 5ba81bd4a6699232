#!/usr/bin/env python3
"""Temperature control compared: every law on the same plants, one programme, one run; a table, plots, limits.

    scripts/bench/bench_control.py [--out out/bench] [--quick]

Plants are the simulator's C code, never a controller's own model; temperatures are the true ones. Beside our laws run
two designs the field ships (scripts/bench/rigs/peers.py, from their documentation). The time-optimal climb is full
power with perfect knowledge, simulated on the same plant. The host's cost is measured last, on this machine.
"""

from __future__ import annotations

import harness  # isort: skip

import argparse
import math
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import control_bench as nozzle
import hotend_bench as hotend
from thermal.control.control_api import Schedule
from thermal.control.predictive import MODEL

# What `model` must reach: name, figure, limit on the reference plant, limit on every other.
LIMITS: tuple[tuple[str, Callable[[Any], float], float, float], ...] = (
    ("settle / optimal", lambda r: r.settle_ratio, 1.15, 1.15),
    ("overshoot degC", lambda r: r.overshoot_c, 1.0, 3.0),
    ("step over minimum s", lambda r: r.step_over_s, 0.10, 0.10),
    ("flow deviation degC", lambda r: r.flow_deviation_c, 0.6, 0.6),
    ("flow steady degC", lambda r: r.flow_steady_c, 0.1, 0.1),
    ("ripple degC p-p", lambda r: r.ripple_c, 0.3, 0.3),
)
LATE_ALLOWANCE = 1.5  # a late host may cost less than half as much again ...
# ... of its own figure on time, as means over these seeds: each figure but the times is the largest of some noise, and
# that of one run is off by 20 to 50 %. A ratio counts as beyond if it is so by two sigma of what the seeds scatter.
LATE_SEEDS, LATE_SEEDS_QUICK, LATE_SIGMA = range(5, 45), range(5, 9), 2.0
LATE_PLANTS = ("reference", "strong")
STEP_COST_US, HOST_SHARE = 100.0, 0.05
WARM_UP_S, HOLD_S = 10.0, 40.0  # of the host, in real time
COLUMNS: tuple[tuple[str, Callable[[Any], str]], ...] = (
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
# Rows of the comparison: how many times as large as model's.
FACTORS: tuple[tuple[str, Callable[[Any], float], float], ...] = (
    ("settle beyond optimal", lambda r: r.settle_s - r.optimal_s, 0.002),
    ("overshoot", lambda r: r.overshoot_c, 0.02),
    ("hold error", lambda r: r.hold_c, 0.02),
    ("ripple", lambda r: r.ripple_c, 0.02),
    ("flow deviation", lambda r: r.flow_deviation_c, 0.02),
    ("flow steady", lambda r: r.flow_steady_c, 0.02),
    ("step beyond the minimum", lambda r: r.step_over_s, 0.002),
)
ARRIVED_C = 3.0  # a law that holds no better than this was never there: its overshoot says nothing


def show(report: harness.Report, title: str, results: Sequence[Any]) -> None:
    heads = ("law", "plant", "link", *(name for name, _ in COLUMNS), "trips")
    rows = [
        (r.controller, r.plant, r.link, *(text(r) for _, text in COLUMNS), f"{r.trips} {r.fault}".strip())
        for r in results
    ]
    report.table(title, heads, rows, 3)


def compare(report: harness.Report, plant: str, results: Sequence[Any]) -> None:
    """How many times better `model` is, figure by figure; the floor of a figure is what its noise is worth."""
    ours, *others = results
    rows: dict[str, dict[str, float]] = {}
    for name, figure, floor in FACTORS:
        compared = [r for r in others if name != "overshoot" or r.overshoot_c > 0.0 or r.hold_c < ARRIVED_C]
        rows[name] = {r.controller: max(floor, figure(r)) / max(floor, figure(ours)) for r in compared}
        for law, factor in rows[name].items():
            report.require(factor >= 1.0, f"{plant}: {law} is better in {name} ({factor:.2f} x)")
    laws = [r.controller for r in others]
    texts = (
        (name, *(f"{row[law]:.1f} x" if law in row else "never there" for law in laws))
        for name, row in rows.items()
    )
    report.table("", ("model is better by", *laws), texts)
    report.figures[f"factors {plant}"] = rows


def judge(report: harness.Report, results: Sequence[Any]) -> None:
    """The limits of `model`."""
    for r in results:
        for name, figure, nominal, other in LIMITS:
            limit = nominal if r.plant == "reference" else other
            if r.link == nozzle.JITTERY.name:
                limit *= LATE_ALLOWANCE
            report.at_most(f"{r.plant}, {r.link}: {name}", figure(r), limit, 3)
        report.require(not r.trips and not r.fault, f"{r.plant}, {r.link}: tripped ({r.trips}) {r.fault}")


@dataclass(frozen=True)
class Degraded:
    """One figure of `model`, on time and with a late host: means over the seeds, degC or s."""

    plant: str
    name: str
    on_time: float
    late: float
    doubt: float  # 1 sigma of late - LATE_ALLOWANCE on_time, from the scatter of the seeds

    @property
    def ratio(self) -> float:
        return self.late / self.on_time if self.on_time > 0.0 else 1.0

    @property
    def beyond(self) -> bool:
        return not self.late - LATE_ALLOWANCE * self.on_time <= LATE_SIGMA * self.doubt


def degraded(plant: str, seeds: Sequence[int]) -> tuple[list[Degraded], list[Any]]:
    """What a late host costs `model` on one plant, figure by figure; and the late runs."""
    on_time = [nozzle.run("model", plant, nozzle.GOOD, seed) for seed in seeds]
    late = [nozzle.run("model", plant, nozzle.JITTERY, seed) for seed in seeds]
    rows = []
    for name, figure in (*((name, figure) for name, figure, *_ in LIMITS), ("hold degC", lambda r: r.hold_c)):
        a, b = [figure(r) for r in on_time], [figure(r) for r in late]
        scatter = statistics.variance(b) + LATE_ALLOWANCE**2 * statistics.variance(a)
        doubt = math.sqrt(scatter / len(seeds))
        rows.append(Degraded(plant, name, statistics.mean(a), statistics.mean(b), doubt))
    return rows, late


def show_degraded(report: harness.Report, rows: Sequence[Degraded], runs: int) -> None:
    title = f"model with a host late by up to 50 ms at random, 250 kBaud, against itself on time; means of {runs} runs"
    texts = (
        (r.plant, r.name, f"{r.on_time:.3f}", f"{r.late:.3f}", f"{r.ratio:.2f}", f"{r.doubt:.3f}")
        for r in rows
    )
    report.table(title, ("plant", "figure", "on time", "late", "ratio", "+- of late"), texts, 2)
    for r in rows:
        text = f"{r.plant}: late host: {r.name} {r.late:.3f}, {r.ratio:.2f} x that on time"
        report.require(not r.beyond, text)


def step_cost_us(printing: bool = False) -> float:
    """Mean time of one step of predictive control while it holds a nozzle, in this process.

    printing: with a flow that changes every 10 ms, so that every step makes a plan of what follows.
    """
    rig = nozzle.make_rig("model", "reference", nozzle.GOOD)
    calls: list[tuple[Any, ...]] = []

    def recorded(*args: Any) -> Any:
        calls.append(args)
        return MODEL.step(*args)

    chosen = rig.loop.parameters.control
    rig.run(nozzle.IDLE_S)
    rig.set_target(nozzle.TARGET_C)
    rig.run(2.0)
    law = type(MODEL)(MODEL.name, recorded, MODEL.start, MODEL.follow)
    rig.loop.parameters = nozzle.replaced(rig.loop.parameters, chosen, law)
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


def plot(path: Path, title: str, results: Sequence[Any], span_s: tuple[float, float], zoom_c: float) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, (whole, near) = plt.subplots(2, 1, figsize=(10, 8), sharex=True, layout="constrained")
    for r in results:
        t_s, temp_c = r.trace
        select = (t_s >= span_s[0]) & (t_s <= span_s[1])
        for axes in (whole, near):
            axes.plot(
                t_s[select],
                temp_c[select],
                label=r.controller,
                linewidth=1.4 if r.controller == "model" else 0.9,
            )
    target_c = nozzle.TARGET_C if results[0].link != "report 0.3 s" else hotend.TARGET_C
    near.set_ylim(target_c - zoom_c, target_c + zoom_c)
    near.axhline(target_c, color="0.6", linewidth=0.6)
    whole.set_title(title)
    whole.legend()
    near.set_xlabel("s since the target was set")
    for axes in (whole, near):
        axes.set_ylabel("degC, true")
        axes.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def records(results: Sequence[Any]) -> list[Any]:
    """Without the traces."""
    return [replace(r, trace=None) for r in results]


def compare_nozzles(out: Path, report: harness.Report) -> None:
    """Every law on the induction nozzle."""
    for preset in ("reference", "strong"):
        results = [nozzle.run(law, preset) for law in (*nozzle.OURS, *nozzle.PEERS)]
        title = f"Induction nozzle, {preset} plant, 25 -> 250 degC, flow 0-25-0 mm3/s, +25 degC"
        show(report, title, results)
        compare(report, preset, results)
        judge(report, results[:1])
        plot(out / f"control-{preset}.png", f"Induction nozzle, {preset}", results, (-0.1, 8.0), 6.0)
        report.figures[preset] = records(results)


def vary_nozzles(quick: bool, report: harness.Report) -> None:
    """`model` on plants unlike its parameters, with a late host, with both."""
    names = list(nozzle.PLANTS)[2 : 4 if quick else None]
    others = [nozzle.run("model", name) for name in names]
    others += [nozzle.run("model", name, nozzle.SLOW) for name in LATE_PLANTS]
    show(report, "model on plants unlike its parameters", others)
    seeds = LATE_SEEDS_QUICK if quick else LATE_SEEDS
    worse: list[Degraded] = []
    late: list[Any] = []
    for name in LATE_PLANTS:
        rows, runs = degraded(name, seeds)
        worse, late = worse + rows, late + runs
    show_degraded(report, worse, len(seeds))
    late_others = [nozzle.run("model", name, nozzle.JITTERY) for name in names]
    show(report, "model with a late host on plants unlike its parameters", late_others)
    unplanned = [nozzle.run("model", "reference", planned=False)]
    show(report, "model, flow not announced (for information)", unplanned)
    judge(report, others + late + late_others)
    report.figures |= {
        "others": records(others),
        "late": records(late + late_others),
        "degraded": worse,
        "unplanned": records(unplanned),
    }


def compare_hotends(out: Path, report: harness.Report) -> None:
    """Every law on the conventional hotend."""
    results = [hotend.run(law, "hotend") for law in hotend.LAWS]
    show(report, "Conventional hotend, 25 -> 220 degC, flow 0-10-0 mm3/s, +20 degC", results)
    compare(report, "hotend", results)
    plot(out / "control-hotend.png", "Conventional hotend", results, (-2.0, 400.0), 12.0)
    others = [hotend.run("model", name) for name in list(hotend.PLANTS)[1:]]
    show(report, "model on hotends unlike its parameters", others)
    report.figures |= {"hotend": records(results), "hotend_others": records(others)}


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
    compare_nozzles(options.out, report)
    vary_nozzles(options.quick, report)
    compare_hotends(options.out, report)
    measure_cost(options.quick, report)
    print(f"plots in {options.out}")


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__, "fewer plants and runs, no host cost")
    parser.add_argument(
        "--out", type=Path, default=harness.ROOT / "out" / "bench", help="folder for the plots"
    )
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
