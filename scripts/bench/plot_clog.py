#!/usr/bin/env python3
"""Receiver operating characteristic of [nozzle_monitor]'s tests, from the statistics that they assume.

    scripts/bench/plot_clog.py docs/images/clog_roc.png

Left: a hole narrowed by a tenth, by vibration. Right: 30 % of the flow lost, by vibration, heat (2 W of melt), both.
Each curve is the share found within some seconds over the false alarms an hour, as the threshold falls. The power of a
step is gamma distributed, the heat Gaussian; no doubt of the laws is taken off.
"""

from __future__ import annotations

import harness

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from thermal.models.heat_loss import HeatCapacity
from thermal.models.melt_exchange import MeltExchange
from thermal.sensing.flow_monitor import FlowMonitorParameters
from thermal.sensing.heat_balance_monitor import TwoNodeLoss
from vibration.mount_witness import MountParameters

CHAINS = 1000
CLEAN_STEPS = 3600  # of a chain: 1,000 hours in all
THRESHOLDS = np.linspace(1.0, 16.0, 61)
MELT_W = 2.0
LOST = 0.3
Ratios = Callable[[np.random.Generator, bool], np.ndarray]


def of_power(p: MountParameters, times: float, weight: float) -> Ratios:
    """Log-likelihood ratios of steps whose power is `times` as great, or not."""

    def draw(rng: np.random.Generator, changed: bool) -> np.ndarray:
        ratio = rng.gamma(weight, (times if changed else 1.0) / weight, CHAINS)
        return weight * (ratio * (1.0 - 1.0 / times) - np.log(times))

    return draw


def of_heat(p: FlowMonitorParameters) -> Ratios:
    variance = p.noise_w_s**2 + (p.model_share * MELT_W) ** 2
    expected_w = LOST * MELT_W

    def draw(rng: np.random.Generator, changed: bool) -> np.ndarray:
        missing_w = rng.normal(expected_w if changed else 0.0, variance**0.5, CHAINS)
        return (missing_w * expected_w - 0.5 * expected_w**2) / variance

    return draw


def curve(draws: list[Ratios], seconds: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """False alarms an hour and the share found within `seconds`, at each threshold."""
    alarms = np.zeros(len(THRESHOLDS))
    sums = np.zeros((len(THRESHOLDS), CHAINS))
    for _ in range(CLEAN_STEPS):
        sums = np.maximum(0.0, sums + sum(draw(rng, False) for draw in draws))
        above = sums > THRESHOLDS[:, None]
        alarms += above.sum(axis=1)
        sums[above] = 0.0
    found = np.zeros((len(THRESHOLDS), CHAINS), dtype=bool)
    total = np.zeros(CHAINS)
    for _ in range(seconds):
        total = np.maximum(0.0, total + sum(draw(rng, True) for draw in draws))
        found |= total > THRESHOLDS[:, None]
    return alarms / (CHAINS * CLEAN_STEPS / 3600.0), found.mean(axis=1)


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Draw what [nozzle_monitor]'s tests find over their false alarms."
    )
    parser.add_argument("output", type=Path)
    output: Path = parser.parse_args().output
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    direct, bowden = MountParameters(), MountParameters(16.0, 10.0, 0.35, 4.91)
    rng = np.random.default_rng(1)
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4))
    for name, p, seconds in (
        ("direct", direct, 3),
        ("direct", direct, 5),
        ("Bowden", bowden, 10),
        ("Bowden", bowden, 20),
    ):
        times = (1.0 - p.restriction) ** (-2.0 * p.exponent)
        alarms, found = curve([of_power(p, times, p.noise_width_hz)], seconds, rng)
        left.plot(alarms, found, label=f"{name}, within {seconds} s")
    power = of_power(direct, (1.0 - LOST) ** 1.8, direct.noise_width_hz)
    heat = of_heat(FlowMonitorParameters(HeatCapacity(), TwoNodeLoss(), MeltExchange()))
    for name, draws in (("vibration", [power]), ("heat", [heat]), ("both", [power, heat])):
        alarms, found = curve(draws, 3, rng)
        right.plot(alarms, found, label=f"{name}, within 3 s")
    left.set(title="hole narrowed by 10 %", ylabel="share found")
    right.set(title="30 % of the flow lost")
    for axes in (left, right):
        axes.set(xscale="log", xlabel="false alarms an hour", xlim=(1e-3, 1e2), ylim=(0.0, 1.02))
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(output, dpi=80)
    return 0


if __name__ == "__main__":
    sys.exit(main())
