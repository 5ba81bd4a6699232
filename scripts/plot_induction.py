#!/usr/bin/env python3
"""Draw raw coil telemetry: a file of INDUCTION_DUMP, or the trace of a calibration run.

    scripts/plot_induction.py DUMP.csv                               leaves DUMP.png beside it
    scripts/plot_induction.py induction-nozzle-....csv --out calibration.png

Exit status 0 drawn, 2 the file is neither, or the picture cannot be written.
"""

from __future__ import annotations

import in_venv

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "klippy"))

from thermal.identification import fit_sensing, fit_sweep, sweep
from thermal.identification.fit_sensing import FitError
from thermal.models.drive_law import DriveLaw

DUMP_COLUMNS = {"time", "phase", "count", "raw_mean", "raw_min", "raw_max"}
ROWS_MAX = 20000  # more dots than a picture shows
GOOD_C = 2.0  # what a calibration should reach


def draw_dump(columns: dict[str, fit_sensing.Array], figure: Figure) -> None:
    top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 2))
    time_s = columns["time"] - columns["time"][0]
    if "temperature" in columns:
        top.plot(time_s, columns["temperature"], lw=1.2, color="C3")
    top.set(ylabel="temperature, °C", title="Temperature, as the law in force has it")
    top.grid(alpha=0.3)
    top.margins(x=0.01)
    middle.step(time_s, 100.0 * (columns["phase"] / fit_sensing.PHASE_FULL_TICKS) ** 2, where="post", lw=0.8)
    middle.set(ylabel="power, % of full", title="Power", ylim=(0.0, None))
    bottom.fill_between(time_s, columns["raw_min"], columns["raw_max"], color="0.85", label="extremes")
    bottom.plot(time_s, columns["raw_mean"], lw=0.8, label="mean")
    title = "Signal of the coil: mean and extremes of each block"
    bottom.set(xlabel="time, s", ylabel="ADC code", title=title)
    bottom.legend(loc="upper right")


def draw_sweep(path: Path, figure: Figure) -> None:
    recording = fit_sweep.read_recording(path)
    result = fit_sweep.analyse(recording, DriveLaw())
    left, middle, right = figure.subplots(1, 3)
    reference = np.array(recording.reference)
    left.plot(reference[:, 0] - reference[0, 0], reference[:, 1])
    left.set(xlabel="time, s", ylabel="reference, °C", title=f"Reference, lag {result.lag.tau_s:.2f} s")
    left.margins(x=0.01)
    points = result.points
    best = result.laws[result.best].regression
    residual = fit_sensing.temperature_residuals(best.law, best.values(), points)
    for ticks in np.unique(points.phase_ticks):
        mask = points.phase_ticks == ticks
        power = float(fit_sensing.power_of_ticks(ticks))
        colour, label = colormaps["turbo"](0.05 + 0.9 * power), f"{100 * power:.3g} %"
        middle.plot(points.temp_c[mask], points.error[mask], ".", color=colour, ms=3, label=label)
        right.plot(points.temp_c[mask], residual[mask], ".", color=colour, ms=3)
    middle.set(xlabel="skin, °C", ylabel="phase signal, units", title="Signal over temperature")
    middle.legend(fontsize=7, title="power", title_fontsize=7)
    scale = max(1.25 * GOOD_C, 1.1 * float(np.nanmax(np.abs(residual), initial=0.0)))
    right.axhspan(-GOOD_C, GOOD_C, color="0.92", zorder=0)
    right.axhline(0.0, color="0.6", lw=0.7)
    rms = float(np.sqrt(np.nanmean(residual**2)))
    title = f"Law {best.law}: rms {rms:.2f} °C (grey: ±{GOOD_C:.0f} °C)"
    right.set(xlabel="skin, °C", ylabel="law − skin, °C", title=title, ylim=(-scale, scale))
    figure.suptitle(f"Calibration run {path.name}")


def _numeric(path: Path) -> dict[str, fit_sensing.Array]:
    """Columns of a dump; an empty cell is NaN."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a last row cut short: its dump was ended half way
            table = np.genfromtxt(path, delimiter=",", names=True, max_rows=ROWS_MAX, invalid_raise=False)
    except ValueError as error:
        raise FitError(f"{path}: {error}") from None
    if not table.size:
        raise FitError(f"{path}: there is a header but no data")
    return {name: np.atleast_1d(table[name]) for name in table.dtype.names or ()}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("--out", type=Path, metavar="OUT.png", help="default: beside the file")
    options = parser.parse_args(argv)
    figure = Figure(figsize=(11, 5), layout="constrained")
    try:
        with options.file.open(encoding="utf-8") as stream:
            first = next((line for line in stream if not line.startswith("#")), "")
        header = set(first.strip().split(","))
        if set(sweep.COLUMNS) <= header:
            draw_sweep(options.file, figure)
        elif header >= DUMP_COLUMNS:
            draw_dump(_numeric(options.file), figure)
        else:
            raise FitError(f"{options.file}: neither a dump nor the trace of a calibration run")
        figure.savefig(options.out or options.file.with_suffix(".png"), dpi=90)
    except UnicodeDecodeError:
        return refuse(f"{options.file} is no text file")
    except OSError as error:
        return refuse(f"{error.filename}: {error.strerror}")
    except (FitError, ValueError) as error:  # ValueError: the ending of OUT is no format
        return refuse(str(error))
    return 0


def refuse(reason: str) -> int:
    """Say why it cannot be done; the exit status."""
    print(f"plot_induction: {reason}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
