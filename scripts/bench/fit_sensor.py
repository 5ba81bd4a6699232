#!/usr/bin/env python3
"""Fit the eddy-current thermometer offline, from a table or a recorded sweep.

    scripts/bench/fit_sensor.py TRACE.csv [--law eq5|exp|tank] [--recipe paper|direct] [--json OUT] [--plot OUT.png]

Exit status 0 fitted, 2 the input cannot be used (the text says why).
"""

from __future__ import annotations

import harness

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from thermal.identification import fit_data, fit_sensing, fit_sweep, sweep

RANGES_C = ((50.0, 350.0), (25.0, 500.0))
WORKING_POWER = 0.20  # accuracy is stated at or below this power fraction: steady printing needs 0.7-9 %


def load_points(path: Path, recipe: str) -> tuple[fit_sensing.Points, list[fit_data.ReducedRun]]:
    data = fit_data.read_calibration(path)
    if set(sweep.COLUMNS) <= fit_data.read_columns(path).keys():  # a run of INDUCTION_CALIBRATE
        recording = fit_sweep.read_recording(path)
        _, beta, centre, half = fit_sweep.estimate_lag(recording, 1.0)
        return fit_sweep.points_of(recording, beta, centre, half), []
    if isinstance(data, fit_sensing.Points):
        return data, []
    if recipe == "direct":
        return fit_data.points_of_trace(data), []
    runs = [fit_data.reduce_run(run) for run in data.runs()]
    if not runs:
        raise fit_sensing.FitError(f"{path}: no stretch of constant power long enough to use")
    return fit_data.points_of_runs(runs), runs


def accuracy(result: fit_sensing.Regression, points: fit_sensing.Points) -> list[dict[str, Any]]:
    """Residuals in degC over the two ranges, at working power and at any power."""
    rows = []
    for low, high in RANGES_C:
        for limit in (WORKING_POWER, 1.0):
            # 0.1 % of slack: 20 % written as ticks and read back is 20.0001 %
            mask = (points.temp_c >= low) & (points.temp_c <= high) & (points.power <= limit * 1.001)
            residual = fit_sensing.temperature_residuals(result.law, result.values(), points.where(mask))
            usable = residual[np.isfinite(residual)]
            rows.append(
                {
                    "range_c": [low, high],
                    "power_up_to_pct": 100 * limit,
                    "points": int(usable.size),
                    "invalid": int(residual.size - usable.size),
                    "max_c": float(np.abs(usable).max()) if usable.size else None,
                    "rms_c": float(np.sqrt(np.mean(usable**2))) if usable.size else None,
                }
            )
    return rows


def text_report(
    result: fit_sensing.Regression, points: fit_sensing.Points, runs: list[fit_data.ReducedRun]
) -> str:
    lines = []
    for run in runs:
        power = float(100 * fit_sensing.power_of_ticks(np.array(run.phase_ticks)))
        lines.append(
            f"run at {power:5.1f} %: {run.recorded} samples reduced to {run.kept} (Ramer-Douglas-Peucker), "
            f"ideal heating curve R2 = {run.curve.r_squared:.4f}, {run.temp_c.size} points read off"
        )
    lines += [
        "",
        f"law {result.law}, {result.n_points} points",
        "coefficient      estimate   std error         t",
    ]
    lines += [f"{c.name:>11} {c.estimate:13.6g} {c.std_error:11.4g} {c.t:9.1f}" for c in result.coefficients]
    verdict = "significant" if result.significant else "NOT significant"
    lines += [
        f"R = {result.r:.5f}   F = {result.f:.4g}   F-critical (alpha 0.05) = {result.f_critical:.2f}: "
        f"{verdict}",
        f"residual: standard deviation {result.residual_sd:.3f}, largest {result.max_residual:.3f} units",
        "",
        "accuracy to expect, from these points' own residuals (noise and drift come on top):",
    ]
    for row in accuracy(result, points):
        low, high = row["range_c"]
        where = f"  {low:.0f}-{high:.0f} degC, power up to {row['power_up_to_pct']:.0f} %: "
        if row["points"] == 0:
            lines.append(where + "no points in this range: nothing can be said")
        else:
            lines.append(
                where + f"max {row['max_c']:.1f} degC, rms {row['rms_c']:.1f} degC ({row['points']} points)"
            )
    spread = ", ".join(f"{row['invalid']} invalid" for row in accuracy(result, points) if row["invalid"])
    return "\n".join(lines + ([f"  outside the law: {spread}"] if spread else []))


def residual_table(result: fit_sensing.Regression, points: fit_sensing.Points) -> str:
    residual = fit_sensing.temperature_residuals(result.law, result.values(), points)
    rows = ["", "  power %   temp degC     error   residual units   residual degC"]
    predicted = fit_sensing.predict(result.law, result.values(), points.temp_c, points.phase_ticks)
    for p, t, e, u, c in zip(
        points.power, points.temp_c, points.error, points.error - predicted, residual, strict=True
    ):
        rows.append(f"{100 * p:9.1f} {t:11.1f} {e:9.1f} {u:16.2f} {c:15.2f}")
    return "\n".join(rows)


def json_report(result: fit_sensing.Regression, points: fit_sensing.Points) -> dict[str, Any]:
    return {
        "law": result.law,
        "coefficients": result.values(),
        "std_errors": {c.name: c.std_error for c in result.coefficients},
        "r": result.r,
        "f": result.f,
        "f_critical": result.f_critical,
        "residual_sd_units": result.residual_sd,
        "points": result.n_points,
        "accuracy": accuracy(result, points),
    }


def draw(result: fit_sensing.Regression, points: fit_sensing.Points, path: Path) -> None:
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    grid = np.linspace(points.temp_c.min(), points.temp_c.max(), 200)
    residual = fit_sensing.temperature_residuals(result.law, result.values(), points)
    for index, ticks in enumerate(np.unique(points.phase_ticks)):
        mask = points.phase_ticks == ticks
        colour, label = f"C{index % 10}", f"{100 * float(fit_sensing.power_of_ticks(ticks)):.3g} %"
        left.plot(points.temp_c[mask], points.error[mask], "o", color=colour, label=label, markersize=4)
        left.plot(
            grid,
            fit_sensing.predict(result.law, result.values(), grid, np.full(grid.size, ticks)),
            color=colour,
            lw=1,
        )
        right.plot(points.temp_c[mask], residual[mask], "o-", color=colour, label=label, markersize=4, lw=0.7)
    left.set(xlabel="temperature, °C", ylabel="error, units", title=f"law {result.law}: R = {result.r:.5f}")
    right.axhspan(-3, 3, color="0.9", zorder=0)
    right.set(xlabel="temperature, °C", ylabel="inverted − reference, °C", title="residual (grey: ±3 °C)")
    left.legend(title="power")
    try:
        figure.savefig(path, dpi=110)
    except ValueError as error:  # the ending is no known format
        raise fit_sensing.FitError(f"{path}: {error}") from None


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "trace", type=Path, help="CSV: t_s,temp_ref_c,error,phase_ticks or power_pct,temp_c,error"
    )
    parser.add_argument("--law", choices=sorted(fit_sensing.FITTERS), default="exp")
    parser.add_argument(
        "--recipe", choices=("direct", "paper"), default="direct", help="how a recording is read"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write coefficients and statistics")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="draw the fit and its residuals")
    options = parser.parse_args(argv)
    try:
        points, runs = load_points(options.trace, options.recipe)
        result = fit_sensing.FITTERS[options.law](points)
        print(text_report(result, points, runs))
        print(residual_table(result, points))
        if options.json:
            options.json.write_text(
                json.dumps(json_report(result, points), indent=2) + "\n", encoding="utf-8"
            )
        if options.plot:
            draw(result, points, options.plot)
    except OSError as error:
        return refuse(f"{error.filename}: {error.strerror}")
    except fit_sensing.FitError as error:
        return refuse(str(error))
    return 0


def refuse(reason: str) -> int:
    """Say why it cannot be done; the exit status."""
    print(f"fit_sensor: {reason}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
