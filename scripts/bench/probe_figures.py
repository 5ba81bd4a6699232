#!/usr/bin/env python3
"""Repeatability, drift and time of the measuring probes: 200 simulated probings each, with noise and a thermal coil.

    scripts/bench/probe_figures.py                the figures, and docs/images/probe_figures.png
    scripts/bench/probe_figures.py --json FILE    the figures as JSON

The coil is calibrated and its drift measured from 25 to 75 degC; then it goes from 0 to 80 degC while the same place is
probed. The load cell has 0.5 g of noise a sample and drifts by 0.2 g/s.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "klippy"), str(ROOT / "scripts" / "bench" / "rigs")]

import eddy_rig  # noqa: E402  (the paths come first)
import probe_rig  # noqa: E402

COUNT = 200
WINDOW = 10  # probings whose spread is the repeatability: within them the drift is small
RAMP_K_S = 0.6
START_S = 3.0  # about, until the first probing
IMAGE = ROOT / "docs" / "images" / "probe_figures.png"
Figures = dict[str, float]


def figures(heights: Sequence[float], seconds: float) -> Figures:
    """um: spread within windows (the mean variance), range of the windows' means; s a probing."""
    windows = [heights[i : i + WINDOW] for i in range(0, len(heights) - WINDOW + 1, WINDOW)]
    means = [statistics.fmean(window) for window in windows]
    variance = statistics.fmean(statistics.variance(window) for window in windows)
    return {
        "probings": len(heights),
        "sigma_um": 1000.0 * variance**0.5,
        "drift_um": 1000.0 * (max(means) - min(means)),
        "seconds": seconds / len(heights),
    }


def eddy(folder: Path) -> tuple[Figures, list[float], list[float], list[float]]:
    """(figures, coil's temperatures, heights with the correction, heights without)."""
    ramp = eddy_rig.coil(coil_temp=25, coil_ramp=0.1, coil_end_temp=80)
    first = eddy_rig.run(folder, eddy_rig.CALIBRATE)
    known = eddy_rig.calibration(first)
    second = eddy_rig.run(folder, eddy_rig.drift_gcode(0.1, 10.0, 6), [*known, *ramp])
    assert second.status == 0, second.reason
    known = eddy_rig.calibration(second)
    sweep = eddy_rig.coil(coil_temp=0, coil_ramp=RAMP_K_S, coil_end_temp=80)
    runs = []
    for enable in (1, 0):
        gcode = f"{eddy_rig.START}TEMPERATURE_PROBE_ENABLE PROBE=coil ENABLE={enable}\nG1 Z1.5 F600\n"
        runs.append(eddy_rig.run(folder, gcode + f"PROBE_ACCURACY SAMPLES={COUNT}\n", [*known, *sweep]))
        assert runs[-1].status == 0, runs[-1].reason
    corrected, plain = ([z for _, _, z in run.found()] for run in runs)
    span = runs[0].times[-1] - runs[0].times[0]
    simulation = runs[0].simulation
    last_c = simulation.world.coil_temperature(simulation.machine.gauges[eddy_rig.SECTION])
    assert last_c > 79.9, f"the coil has reached {last_c:.1f} degC only"
    passed = [time - runs[0].times[0] for time in runs[0].times]
    temps = [min(80.0, RAMP_K_S * (START_S + time)) for time in passed]
    return figures(corrected, span * COUNT / (COUNT - 1)), temps, corrected, plain


def load_cell(folder: Path) -> tuple[Figures, list[float]]:
    config = probe_rig.ROOT / "config" / "probes" / "sim-load-cell.cfg"
    gcode = f"G28\nPROBE_ACCURACY SAMPLES={COUNT}\n"
    result = probe_rig.run(folder, gcode, *probe_rig.FLAT, config=config)
    assert result.status == 0, result.reason
    heights = [z for _, _, z in result.found()]
    span = result.times[-1] - result.times[0]
    return figures(heights, span * COUNT / (COUNT - 1)), heights


def plot(
    temps: Sequence[float], corrected: Sequence[float], plain: Sequence[float], force: Sequence[float]
) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9.0, 3.4), constrained_layout=True)
    for heights, label in ((plain, "without correction"), (corrected, "with drift calibration")):
        left.plot(temps, [1000.0 * (z - 0.5) for z in heights], ".", markersize=3, label=label)
    left.set(xlabel="temperature of the coil, °C", ylabel="error, µm", title="coil (LDC1612), 200 probings")
    left.legend()
    right.plot([1000.0 * z for z in force], ".", markersize=3)
    right.set(xlabel="probing", ylabel="height of the contact, µm", title="load cell (HX717), 200 probings")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.savefig(IMAGE, dpi=100)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as name:
        coil, temps, corrected, plain = eddy(Path(name))
        cell, force = load_cell(Path(name))
    table = {"eddy": coil, "load_cell": cell}
    for kind, found in table.items():
        print(
            f"{kind}: {found['probings']:.0f} probings, sigma {found['sigma_um']:.2f} um,"
            f" drift {found['drift_um']:.1f} um, {found['seconds']:.2f} s each"
        )
    if args.json:
        args.json.write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")
    plot(temps, corrected, plain, force)
    return 0


if __name__ == "__main__":
    sys.exit(main())
