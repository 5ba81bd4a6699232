"""What the plant does where tables were published; for the tests and scripts/bench/plot_plant.py."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from pure_harness import ROOT, Load, Plant

TABLES: dict[str, Any] = json.loads((ROOT / "test" / "data" / "oskolkov2021.json").read_text())
SIGNAL_AVERAGE = 4096  # samples: leaves 1/64 of the ADC's noise


def table1_errors(**changes: float) -> tuple[np.ndarray, np.ndarray]:
    """(plant, table): signal units, one row a temperature, one column a power."""
    table = TABLES["table1"]
    plant_errors = np.zeros_like(np.array(table["error"], dtype=float))
    for i, temp_c in enumerate(table["T_degC"]):
        for j, percent in enumerate(table["power_pct"]):
            plant = Plant(start_c=temp_c, **changes)
            plant.power(percent)
            plant.sample(100)  # settling
            plant_errors[i, j] = plant.sample(SIGNAL_AVERAGE).mean() - 256
    return plant_errors, np.array(table["error"], dtype=float)


def hold(plant: Plant, temp_c: float, seconds: float = 120.0) -> float:
    """Hold the skin at a temperature until both nodes are still; returns the power into the metal in W.

    A PI controller that sees the true temperature: a tool of the test, no model of the real one.
    """
    heat_w = plant.lib.plant_get_param(plant.c, plant.lib.plant_param_index(b"heat_w"))
    integral_w, dt_s = 0.0, 2e-3
    for _ in range(round(seconds / dt_s)):
        error_c = temp_c - plant.read().skin_c
        integral_w = min(max(integral_w + 0.25 * error_c * dt_s, 0.0), heat_w)
        power_w = min(max(2.0 * error_c + integral_w, 0.0), heat_w)
        plant.phase(45000 * 2 / math.pi * math.asin((power_w / heat_w) ** (2 / 3)))
        plant.advance(dt_s)
    return float(plant.read().power_w)


def fall_times(device: Plant | Load, marks_c: tuple[float, ...], dt_s: float = 5e-3) -> dict[float, float]:
    """Seconds from now until each temperature is reached from above, with no power."""
    key = "skin_c" if isinstance(device, Plant) else "body_c"
    times: dict[float, float] = {}
    now_s, before_c = 0.0, getattr(device.read(), key)
    for mark_c in marks_c:
        after_c = before_c
        while after_c > mark_c and now_s < 1000:
            before_c = after_c
            device.advance(dt_s)
            now_s += dt_s
            after_c = getattr(device.read(), key)
        share = (before_c - mark_c) / (before_c - after_c) if before_c > after_c else 1.0
        times[mark_c] = now_s - dt_s * (1 - share) if before_c > after_c else now_s
    return times


def table5_times(column: str) -> list[tuple[int, int, float, float]]:
    """(from, to, published s, simulated s) for `induction` or `conventional`, as one run from 300 degC steady."""
    device: Plant | Load
    if column == "induction":
        device = Plant(start_c=300)
        hold(device, 300)
        device.phase(0)
    else:
        device = Load("hotend", start_c=300)
    rows = TABLES["table5_cooling_s"]["rows"]
    marks = tuple(sorted({row[end] for row in rows for end in ("from", "to")}, reverse=True))
    times = fall_times(device, marks, 5e-3 if column == "induction" else 20e-3)
    return [
        (row["from"], row["to"], float(row[column]), times[row["to"]] - times[row["from"]]) for row in rows
    ]


def heat_up_s(preset: str, percent: float, to_c: float, **changes: float) -> float:
    """Seconds from 20 degC to a temperature at constant power."""
    plant, dt_s, now_s = Plant(preset, start_c=20, **changes), 1e-3, 0.0
    plant.power(percent)
    while plant.read().skin_c < to_c:
        plant.advance(dt_s)
        now_s += dt_s
    return now_s
