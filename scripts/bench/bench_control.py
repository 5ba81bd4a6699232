#!/usr/bin/env python3
"""Temperature control compared: every law on the same plants, one programme, one run; a table, plots, limits.

    scripts/bench/bench_control.py [--out out/bench] [--quick]

Plants are the simulator's C code, never a controller's own model; temperatures are the true ones. Beside our laws run
two designs the field ships (scripts/bench/rigs/peers.py, from their documentation). The time-optimal climb is full
power with perfect knowledge, simulated on the same plant. The host's cost is measured last, on this machine. Exit
status 1 if `model` misses a limit.
"""

from __future__ import annotations

from bench_paths import ROOT  # isort: skip

import argparse
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

import bench_api
import control_bench as bench
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
    ("least", lambda r: f"{r.step_min_s:.3f}"),
)
# Rows of the comparison: how many times as large as model's.
FACTORS: tuple[tuple[str, Callable[[Any], float], float], ...] = (
    ("settle beyond optimal", lambda r: r.settle_s - r.optimal_s, 0.002),
    ("overshoot", lambda r: r.overshoot_c, 0.02),
    ("hold error", lambda r: r.hold_c, 0.02),
    ("ripple", lambda r: r.ripple_c, 0.02),
    ("flow deviation", lambda r: r.flow_deviation_c, 0.02),
    ("flow steady", lambda r: r.flow_steady_c, 0.02),
    ("step beyond the least", lambda r: r.step_over_s, 0.002),
)
ARRIVED_C = 3.0  # a law that holds no better than this was never there: its overshoot says nothing
console = Console(width=150)


def show(title: str, results: Sequence[Any]) -> None:
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1))
    for name in ("law", "plant", "link", *(name for name, _ in COLUMNS), "trips"):
        table.add_column(name, justify="left" if name in ("law", "plant", "link") else "right", no_wrap=True)
    for r in results:
        cells = [text(r) for _, text in COLUMNS]
        table.add_row(
            r.controller, r.plant, r.link, *cells, str(r.trips) + (" " + r.fault if r.fault else "")
        )
    console.print(table, "")


def show_factors(title: str, results: Sequence[Any]) -> list[dict[str, Any]]:
    """How many times better `model` is, row by row; the floor of a figure is what its noise is worth."""
    ours = next(r for r in results if r.controller == "model")
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1))
    table.add_column("model is better by")
    others = [r for r in results if r is not ours]
    rows = []
    for r in others:
        table.add_column(r.controller, justify="right")
    for name, figure, floor in FACTORS:
        compared = [r for r in others if name != "overshoot" or r.overshoot_c > 0.0 or r.hold_c < ARRIVED_C]
        factors = {r.controller: max(floor, figure(r)) / max(floor, figure(ours)) for r in compared}
        rows.append({"figure": name, **factors})
        cells = (f"{factors[r.controller]:.1f} x" if r in compared else "never there" for r in others)
        table.add_row(name, *cells)
    console.print(table, "")
    return rows


def beaten(plant: str, rows: Sequence[dict[str, Any]]) -> list[str]:
    """Rows of the comparison in which another law is better, in words."""
    return [
        f"{plant}: {law} is better in {row['figure']} ({factor:.2f} x)"
        for row in rows
        for law, factor in row.items()
        if law != "figure" and factor < 1.0
    ]


def missed(results: Sequence[Any]) -> list[str]:
    """Limits of `model` that do not hold, in words."""
    texts = []
    for r in results:
        for name, figure, nominal, other in LIMITS:
            limit = nominal if r.plant == "reference" else other
            if r.link == bench.JITTERY.name:
                limit *= LATE_ALLOWANCE
            if not figure(r) <= limit:
                texts.append(f"{r.plant}, {r.link}: {name} {figure(r):.3f}, limit {limit:.3f}")
        if r.trips or r.fault:
            texts.append(f"{r.plant}, {r.link}: tripped ({r.trips}) {r.fault}")
    return texts


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
    on_time = [bench.run("model", plant, bench.GOOD, seed) for seed in seeds]
    late = [bench.run("model", plant, bench.JITTERY, seed) for seed in seeds]
    rows = []
    for name, figure in (*((name, figure) for name, figure, *_ in LIMITS), ("hold degC", lambda r: r.hold_c)):
        a, b = [figure(r) for r in on_time], [figure(r) for r in late]
        scatter = statistics.variance(b) + LATE_ALLOWANCE**2 * statistics.variance(a)
        doubt = math.sqrt(scatter / len(seeds))
        rows.append(Degraded(plant, name, statistics.mean(a), statistics.mean(b), doubt))
    return rows, late


def show_degraded(rows: Sequence[Degraded], runs: int) -> None:
    title = f"model with a host late by up to 50 ms at random, 250 kBaud, against itself on time; means of {runs} runs"
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1))
    for name in ("plant", "figure", "on time", "late", "ratio", "+- of late"):
        table.add_column(name, justify="left" if name in ("plant", "figure") else "right", no_wrap=True)
    for r in rows:
        cells = (f"{r.on_time:.3f}", f"{r.late:.3f}", f"{r.ratio:.2f}", f"{r.doubt:.3f}")
        table.add_row(r.plant, r.name, *cells)
    console.print(table, "")


def step_cost_us(printing: bool = False) -> float:
    """Mean time of one step of the model law while it holds a nozzle, in this process.

    printing: with a flow that changes every 10 ms, so that every step makes a plan of what follows.
    """
    rig = bench.make_rig("model", "reference", bench.GOOD)
    calls: list[tuple[Any, ...]] = []

    def recorded(*args: Any) -> Any:
        calls.append(args)
        return MODEL.step(*args)

    chosen = rig.loop.parameters.control
    rig.run(bench.IDLE_S)
    rig.set_target(bench.TARGET_C)
    rig.run(2.0)
    law = type(MODEL)(MODEL.name, recorded, MODEL.start, MODEL.follow)
    rig.loop.parameters = bench.replaced(rig.loop.parameters, chosen, law)
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
    config = ROOT / "config" / "sim-induction.cfg"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        port, socket = folder / "mcu", folder / "sock"
        path = folder / "printer.cfg"
        path.write_text(f"[include {config}]\n[mcu]\nserial: {port}\n", encoding="utf-8")
        scripts = (
            (ROOT / "scripts" / "run_simulator.py", path, "--pty", port),
            (ROOT / "klippy" / "klippy.py", path, "-a", socket, "-I", folder / "tty", "-l", folder / "log"),
        )
        running = []
        try:
            for words in scripts:
                running.append(
                    subprocess.Popen([sys.executable, *map(str, words)], stdout=subprocess.DEVNULL)
                )
            client = bench_api.connect(socket)
            client.ask("gcode/script", script="M104 S250")
            time.sleep(WARM_UP_S)
            before = bench_api.cpu_s(running[1].pid)
            time.sleep(hold_s)
            share = (bench_api.cpu_s(running[1].pid) - before) / hold_s
            held = client.ask("info")["state"] == "ready"
            return share if held else math.nan
        finally:
            for process in reversed(running):
                process.terminate()
                process.wait()


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
    target_c = bench.TARGET_C if results[0].link != "report 0.3 s" else hotend.TARGET_C
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


def compare_nozzles(out: Path, record: dict[str, Any]) -> list[str]:
    """Every law on the induction nozzle; what is missed, in words."""
    texts = []
    for preset in ("reference", "strong"):
        results = [bench.run(law, preset) for law in (*bench.OURS, *bench.PEERS)]
        show(f"Induction nozzle, {preset} plant, 25 -> 250 degC, flow 0-25-0 mm3/s, +25 degC", results)
        factors = show_factors("", results)
        plot(out / f"control-{preset}.png", f"Induction nozzle, {preset}", results, (-0.1, 8.0), 6.0)
        record.update({preset: results, f"factors {preset}": factors})
        texts += missed(results[:1]) + beaten(preset, factors)
    return texts


def vary_nozzles(quick: bool, record: dict[str, Any]) -> list[str]:
    """`model` on plants it was not told of, with a late host, with both; what is missed, in words."""
    names = list(bench.PLANTS)[2 : 4 if quick else None]
    others = [bench.run("model", name) for name in names]
    others += [bench.run("model", name, bench.SLOW) for name in LATE_PLANTS]
    show("model on plants it was not told of", others)
    seeds = LATE_SEEDS_QUICK if quick else LATE_SEEDS
    worse: list[Degraded] = []
    late: list[Any] = []
    for name in LATE_PLANTS:
        rows, runs = degraded(name, seeds)
        worse, late = worse + rows, late + runs
    show_degraded(worse, len(seeds))
    late_others = [bench.run("model", name, bench.JITTERY) for name in names]
    show("model with a late host on plants it was not told of", late_others)
    unplanned = [bench.run("model", "reference", planned=False)]
    show("model, flow it was not told of (for information)", unplanned)
    record.update(others=others, late=late + late_others, degraded=worse, unplanned=unplanned)
    return missed(others + late + late_others) + [
        f"{r.plant}: late host: {r.name} {r.late:.3f}, {r.ratio:.2f} x that on time"
        for r in worse
        if r.beyond
    ]


def compare_hotends(out: Path, record: dict[str, Any]) -> list[str]:
    """Every law on the conventional hotend; rows in which another law is better, in words."""
    hot = [hotend.run(law, "hotend") for law in hotend.LAWS]
    show("Conventional hotend, 25 -> 220 degC, flow 0-10-0 mm3/s, +20 degC", hot)
    factors = show_factors("", hot)
    plot(out / "control-hotend.png", "Conventional hotend", hot, (-2.0, 400.0), 12.0)
    others = [hotend.run("model", name) for name in list(hotend.PLANTS)[1:]]
    show("model on hotends it was not told of", others)
    record.update({"hotend": hot, "hotend_others": others, "factors hotend": factors})
    return beaten("hotend", factors)


def measure_cost(quick: bool, record: dict[str, Any]) -> list[str]:
    """Time of a step, share of a core; what is too much, in words."""
    texts = []
    cost_us, busy_us = step_cost_us(), step_cost_us(printing=True)
    record.update(step_us=cost_us, step_printing_us=busy_us)
    console.print(
        f"model: {cost_us:.0f} us a step (limit {STEP_COST_US:.0f}), {busy_us:.0f} us while the flow changes"
    )
    if cost_us > STEP_COST_US:
        texts.append(f"a step of the model law takes {cost_us:.0f} us")
    if quick:
        return texts
    share = host_share(HOLD_S)
    record["host_share"] = share if math.isfinite(share) else None
    console.print(
        f"whole host, holding one nozzle in real time: {100 * share:.1f} % of a core"
        f" (limit {100 * HOST_SHARE:.0f} %)"
    )
    if not share <= HOST_SHARE:
        texts.append(f"the host takes {100 * share:.1f} % of a core")
    return texts


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description="Compare the temperature control laws.")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench")
    parser.add_argument("--quick", action="store_true", help="fewer plants and runs, no host cost")
    options = parser.parse_args(argv)
    record: dict[str, Any] = {}
    texts = compare_nozzles(options.out, record) + vary_nozzles(options.quick, record)
    texts += compare_hotends(options.out, record) + measure_cost(options.quick, record)
    options.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(
        record, default=lambda r: {k: v for k, v in asdict(r).items() if k != "trace"}, indent=1
    )
    (options.out / "control.json").write_text(text + "\n", encoding="utf-8")
    for text in texts:
        console.print(f"MISSED: {text}", markup=False)
    console.print(
        "all limits hold" if not texts else f"{len(texts)} limits missed", f"- plots in {options.out}"
    )
    return 1 if texts else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
