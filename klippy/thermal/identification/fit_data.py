"""Reading calibration recordings: CSV text -> Points for fit_sensing.py.

Two kinds of file, recognised by their header:

    power_pct,temp_c,error              a finished table such as Table 1 of Sensors 2021, 21(7), 2561
    t_s,temp_ref_c,error,phase_ticks    a recorded sweep: heating runs at fixed powers with a reference sensor
"""

from __future__ import annotations

import csv
import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .fit_sensing import (
    Array,
    FitError,
    HeatingCurve,
    Points,
    fit_heating_curve,
    reduce_curve,
    scale_to_reference,
    ticks_of_power,
)

TABLE_COLUMNS = ("power_pct", "temp_c", "error")
# The trace of a calibration run (sweep.py) is such a sweep with two columns more, powers visited in turns.
TRACE_COLUMNS = ("t_s", "temp_ref_c", "error", "phase_ticks")


@dataclass(frozen=True, slots=True)
class Trace:
    """A recorded sweep; every array has shape (n,), time ascending."""

    t_s: Array
    temp_ref_c: Array
    error: Array
    phase_ticks: Array

    def runs(self, min_points: int = 8) -> list[Trace]:
        """The stretches of constant phase, shortest ones (settling, switching) left out."""
        edges = np.flatnonzero(np.diff(self.phase_ticks)) + 1
        bounds = [0, *edges.tolist(), self.t_s.size]
        return [
            Trace(self.t_s[a:b], self.temp_ref_c[a:b], self.error[a:b], self.phase_ticks[a:b])
            for a, b in itertools.pairwise(bounds)
            if b - a >= min_points and self.phase_ticks[a] > 0
        ]


@dataclass(frozen=True, slots=True)
class ReducedRun:
    """One heating run after the paper's recipe: its curve and the (temperature, error) pairs read off it."""

    phase_ticks: float
    kept: int
    recorded: int
    curve: HeatingCurve
    temp_c: Array
    error: Array


def read_columns(path: Path) -> dict[str, Array]:
    """Named numeric columns of a CSV file.  Raises FitError naming file and line of what is wrong."""
    try:
        text = path.read_text(encoding="utf-8-sig")  # a spreadsheet's "CSV UTF-8" begins with a mark
    except UnicodeDecodeError:
        raise FitError(f"{path} is no text file") from None
    return _columns(path, (line for line in text.splitlines() if not line.startswith("#")))


def _columns(path: Path, lines: Iterable[str]) -> dict[str, Array]:
    reader = csv.reader(lines)
    header = [name.strip() for name in next(reader, [])]
    if not header:
        raise FitError(f"{path}: the file is empty")
    if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
        raise FitError(
            f"{path}: columns have to be separated by commas, and decimals by points: '{header[0]}'"
        )
    rows: list[list[float]] = []
    for number, row in enumerate(reader, 2):
        if not row:
            continue
        if len(row) != len(header):
            raise FitError(f"{path}: row {number} has {len(row)} values, the header names {len(header)}")
        try:
            rows.append([float(value) for value in row])
        except ValueError as error:
            raise FitError(f"{path}: row {number}: {error}") from None
    if not rows:
        raise FitError(f"{path}: there is a header but no data")
    table = np.array(rows, dtype=float)
    return {name: table[:, i] for i, name in enumerate(header)}


def read_calibration(path: Path) -> Points | Trace:
    """Points of a table file, or the Trace of a recording.  Raises FitError if it is neither."""
    columns = read_columns(path)
    if set(TABLE_COLUMNS) <= columns.keys():
        power = columns["power_pct"] / 100.0
        if power.min() < 0 or power.max() > 1:
            raise FitError(f"{path}: power_pct must lie between 0 and 100")
        return Points(columns["temp_c"], ticks_of_power(power), columns["error"])
    if set(TRACE_COLUMNS) <= columns.keys():
        if np.any(np.diff(columns["t_s"]) < 0):
            raise FitError(f"{path}: t_s must not run backwards")
        return Trace(*(columns[name] for name in TRACE_COLUMNS))
    raise FitError(
        f"{path}: columns are {', '.join(columns)}; expected either "
        f"{','.join(TABLE_COLUMNS)} or {','.join(TRACE_COLUMNS)}"
    )


def points_of_trace(trace: Trace, step_c: float = 10.0) -> Points:
    """Every run averaged in bins of `step_c` of the reference temperature: the direct recipe."""
    temp, phase, error = [], [], []
    for run in trace.runs():
        bins = np.floor(run.temp_ref_c / step_c)
        for value in np.unique(bins):
            mask = bins == value
            temp.append(run.temp_ref_c[mask].mean())
            error.append(run.error[mask].mean())
            phase.append(run.phase_ticks[0])
    if not temp:
        raise FitError("the recording holds no stretch of constant power long enough to use")
    return Points(np.array(temp), np.array(phase), np.array(error))


def reduce_run(run: Trace, step_c: float = 10.0, tolerance_sd: float = 3.0) -> ReducedRun:
    """The paper's recipe (section 3.1) for one run: reduce, fit, scale to the ends, read off every step_c.

    `tolerance_sd` is the reduction's tolerance in standard deviations of the signal's own noise.
    """
    noise = float(np.std(np.diff(run.error)) / np.sqrt(2.0))
    kept = reduce_curve(run.t_s, run.error, max(tolerance_sd * noise, 1e-6))
    if kept.size < 4:  # a straight run reduces to its ends: give the quadratic its points back
        kept = np.unique(np.linspace(0, run.t_s.size - 1, min(40, run.t_s.size)).astype(int))
    curve = fit_heating_curve(run.t_s[kept], run.error[kept])
    dense = np.linspace(curve.start_s, curve.end_s, 2000)
    temp = scale_to_reference(curve, dense, float(run.temp_ref_c[0]), float(run.temp_ref_c[-1]))
    if np.any(np.diff(temp) * np.sign(temp[-1] - temp[0]) <= 0):
        raise FitError(
            "the ideal heating curve turns back on itself: this run cannot be read by the paper's recipe"
        )
    low, high = sorted((float(temp[0]), float(temp[-1])))
    grid = np.arange(np.ceil(low / step_c), np.floor(high / step_c) + 1) * step_c
    order = np.argsort(temp)
    times = np.interp(grid, temp[order], dense[order])
    return ReducedRun(
        float(run.phase_ticks[0]),
        int(kept.size),
        int(run.t_s.size),
        curve,
        grid,
        np.interp(times, run.t_s, run.error),
    )


def points_of_runs(runs: list[ReducedRun]) -> Points:
    return Points(
        np.concatenate([r.temp_c for r in runs]),
        np.concatenate([np.full(r.temp_c.size, r.phase_ticks) for r in runs]),
        np.concatenate([r.error for r in runs]),
    )
