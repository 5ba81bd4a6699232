#!/usr/bin/env python3
"""Draw the simulated nozzle against the published tables it was fitted to: docs/images/plant_vs_tables.png.

Four panels: Table 1 (signal over temperature at four powers), Table 5 (cooling without power, induction and
conventional), static losses, and heating up. The same functions give the tests in test/c/test_plant_tables.py their
numbers. Usage: scripts/bench/plot_plant.py [OUTPUT.png]
"""

from __future__ import annotations

import harness

import argparse
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl

ROOT = harness.ROOT
OUTPUT = ROOT / "docs" / "images" / "plant_vs_tables.png"
STATIC_LOSS_W = {212: 3.9, 250: 4.7, 500: 11.0}  # power into the metal that holds the temperature
COLORS = ("#1f77b4", "#2ca02c", "#ff7f0e", "#d62728")


def draw_table1(axes: Any, tables: Any) -> None:
    plant, published = tables.table1_errors()
    table = tables.TABLES["table1"]
    for column, (power, color) in enumerate(zip(table["power_pct"], COLORS, strict=True)):
        axes.plot(table["T_degC"], plant[:, column], color=color, label=f"{power:g} %")
        axes.plot(table["T_degC"], published[:, column], "o", color=color, mfc="none")
    rms = float(((plant - published) ** 2).mean() ** 0.5)
    axes.set(title=f"Table 1: signal, {rms:.1f} units rms", xlabel="nozzle, °C", ylabel="error signal, units")
    axes.legend(title="power")


def draw_table5(axes: Any, tables: Any) -> None:
    for column, color in (("induction", COLORS[3]), ("conventional", COLORS[0])):
        rows = tables.table5_times(column)
        names = [f"{start}→{end}" for start, end, _, _ in rows]
        axes.plot(
            names, [row[3] for row in rows], "_", ms=18, mew=2, color=color, label=f"{column}, simulated"
        )
        axes.plot(names, [row[2] for row in rows], "o", mfc="none", color=color, label=f"{column}, published")
    axes.set(title="Table 5: cooling without power", ylabel="time, s", yscale="log")
    axes.tick_params(axis="x", rotation=45)
    axes.legend()


def draw_losses(axes: Any, tables: Any) -> None:
    temps = (100, 150, 212, 250, 300, 400, 500)
    losses = [tables.hold(tables.Plant(start_c=temp_c), temp_c) for temp_c in temps]
    axes.plot(temps, losses, color=COLORS[3], label="simulated")
    axes.plot(list(STATIC_LOSS_W), list(STATIC_LOSS_W.values()), "ko", mfc="none", label="published")
    axes.set(title="Static loss", xlabel="nozzle, °C", ylabel="power into the metal, W")
    axes.legend()


def draw_heating(axes: Any, tables: Any) -> None:
    for (preset, percent), color in zip(
        (("reference", 10), ("reference", 50), ("reference", 90), ("strong", 100)), COLORS, strict=True
    ):
        plant = tables.Plant(preset)
        plant.power(percent)
        times, temps = [0.0], [20.0]
        while times[-1] < 10 and temps[-1] < 750:
            plant.advance(0.02)
            times.append(times[-1] + 0.02)
            temps.append(plant.read().skin_c)
        axes.plot(times, temps, color=color, label=f"{preset}, {percent} %")
    axes.set(title="Heating up from 20 °C", xlabel="time, s", ylabel="nozzle, °C")
    axes.legend()


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description="Draw the simulated nozzle against the published tables.")
    parser.add_argument("output", type=Path, nargs="?", default=OUTPUT)
    output: Path = parser.parse_args(arguments).output
    sys.path.insert(0, str(ROOT / "test" / "rigs"))
    tables = importlib.import_module("plant_tables")
    mpl.use("Agg")
    plt = importlib.import_module("matplotlib.pyplot")
    figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    for draw, place in zip((draw_table1, draw_table5, draw_losses, draw_heating), axes.flat, strict=True):
        draw(place, tables)
        place.grid(alpha=0.3)
    figure.suptitle("The simulated nozzle (lines) and the published figures (circles)")
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=90)
    print(f"wrote {output}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
