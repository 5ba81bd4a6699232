"""From the recording of a calibration run (sweep.py) to laws with their figures. Offline code: numpy.

    python -m thermal.identification.fit_sweep TRACE.csv [--gain 1.0] [--power-full 81.3] ...      the result as JSON

The printer runs it as a process of its own: a fit of seconds must not hold up the host.

1. Lag. The reference follows the skin with a first-order lag (tau) and a gain g about 25 degC (Oskolkov 2021, Table 6).
   At the smallest phase the skin's temperature is a smooth, steep function of the signal, T = poly(signal). Low-pass
   filtered with tau it must give the readings, in heating and in cooling. The polynomial is fitted by least squares
   at each tau; the best tau is kept. tau is well determined: the run heats fast and cools slowly. The gain is
   not. A sensor that reads 6 % too low fits as well with a law that is 6 % off, and the only equilibrium of a run, its
   start, is near 25 degC, where the gain has no effect. It has to be known (Table 6: 1.0 at half height, 0.94 and 0.86
   at the ends).
2. Points. Each visit to a power lies between two stretches at the smallest phase. Its temperature is interpolated.
3. Laws. eq5, exp, tank and tank with a table (fit_table.py) are fitted to two thirds of the points and judged on the
   last third.
4. Heat. Capacity and losses of the two-node model follow from the heat that went in and the temperatures that came out.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import optimize

from thermal.models import heat_loss
from thermal.models.drive_law import DriveLaw
from thermal.sensing import heat_balance_monitor
from thermal.sensing.block_temperature import SENSING_PHASE_TICKS
from thermal.sensing.laws import LawTable

from . import fit_sensing, fit_table
from .fit_data import read_columns
from .fit_sensing import Array, FitError, Points
from .sweep import COLUMNS, READING_MARK, Recording

GAIN_CENTRE_C = 25.0  # Table 6's gains are about this
GRID_S = 0.02
POLY_ORDER, POLY_ORDER_FEW = 4, 3
READINGS_MIN, READINGS_FEW = 12, 40  # a person types some twenty, a sensor gives hundreds
LAG_LIMITS_S = (0.02, 12.0)
WORKING_POWER = 0.2015
HELD_OUT = 3  # every third point
TABLE_WORTH = 0.7  # the table's held-out error as a share of the plain law's


@dataclass(frozen=True, slots=True)
class Lag:
    """The reference's behaviour as far as the run determines it."""

    tau_s: float
    gain: float  # as given, see the module's text
    residual_c: float  # readings against the lagged polynomial, rms


@dataclass(frozen=True, slots=True)
class LawFigures:
    """One law, fitted to the whole recording; the figures are those of points that were left out of a fit."""

    regression: fit_sensing.Regression
    table: LawTable | None
    held_out_max_c: float  # up to 20 % power, 50-350 degC
    held_out_rms_c: float
    all_powers_rms_c: float
    all_powers_max_c: float

    def residuals(self, points: Points) -> Array:
        """Inverted minus reference temperature at each point, degC."""
        return _residuals(self.regression, self.table, points)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Result of one run."""

    lag: Lag
    points: Points
    laws: dict[str, LawFigures]
    best: str
    capacity_j_k: float  # at 25 degC, in heat of the drive law
    loss_factor: float
    second_factor: float  # second mass over the reference nozzle's
    ambient_c: float
    heat_residual_c: float


def phase_low(recording: Recording) -> int:
    """Of the looks, ticks."""
    return min((phase for _, _, phase, _, _ in recording.blocks if phase), default=SENSING_PHASE_TICKS)


def _low_rows(recording: Recording) -> tuple[Array, Array]:
    low_ticks = phase_low(recording)
    rows = np.array([(t, e) for t, e, phase, _, _ in recording.blocks if phase == low_ticks])
    if len(rows) < 200:
        raise FitError("the recording holds too few blocks at the minimum phase")
    return rows[:, 0], rows[:, 1]


def _lagged(values: Array, tau_s: float) -> Array:
    """First-order lag on the grid, exact for straight lines between its points; starts settled."""
    decay = np.exp(-GRID_S / tau_s)
    share = tau_s / GRID_S * (1.0 - decay)
    out = np.empty_like(values)
    out[0] = state = values[0]
    for i in range(1, len(values)):
        state = decay * state + (share - decay) * values[i - 1] + (1.0 - share) * values[i]
        out[i] = state
    return out


def estimate_lag(recording: Recording, gain: float) -> tuple[Lag, Array, float, float]:
    """(lag, polynomial coefficients, centre and half span of the error it takes). Raises FitError."""
    time_s, error = _low_rows(recording)
    reference = np.array(recording.reference)
    inside = (reference[:, 0] > time_s[0]) & (reference[:, 0] < time_s[-1])
    reference = reference[inside]
    if len(reference) < READINGS_MIN or np.ptp(reference[:, 1]) < 80.0:
        raise FitError("the reference's readings are too few or span less than 80 C")
    grid_s = np.arange(time_s[0], time_s[-1], GRID_S)
    on_grid = np.interp(grid_s, time_s, error)
    centre, half = 0.5 * (error.max() + error.min()), 0.5 * np.ptp(error)
    x = (on_grid - centre) / half
    wanted = GAIN_CENTRE_C + (reference[:, 1] - GAIN_CENTRE_C) / gain

    order = POLY_ORDER if len(reference) >= READINGS_FEW else POLY_ORDER_FEW

    def solve(log_tau: float) -> tuple[float, Array]:
        tau_s = float(np.exp(log_tau))
        columns = [_lagged(x**k, tau_s) for k in range(order + 1)]
        design = np.column_stack([np.interp(reference[:, 0], grid_s, c) for c in columns])
        beta = np.linalg.lstsq(design, wanted, rcond=None)[0]
        return float(np.sqrt(np.mean((design @ beta - wanted) ** 2))), beta

    coarse = np.linspace(float(np.log(LAG_LIMITS_S[0])), float(np.log(LAG_LIMITS_S[1])), 16)
    costs = [solve(v)[0] for v in coarse]
    at = int(np.argmin(costs))
    low, high = coarse[max(0, at - 1)], coarse[min(len(coarse) - 1, at + 1)]
    best = optimize.minimize_scalar(
        lambda v: solve(v)[0], bounds=(low, high), method="bounded", options={"xatol": 1e-3}
    )
    cost, beta = solve(float(best.x))
    return Lag(float(np.exp(best.x)), gain, cost), beta, float(centre), float(half)


def _visits(recording: Recording) -> list[tuple[float, float, int]]:
    """(time, error, phase) of each visit to a higher power: the mean of its blocks."""
    out: list[tuple[float, float, int]] = []
    held: list[tuple[float, float, int, int, float]] = []
    low_ticks = phase_low(recording)

    def close() -> None:
        count = sum(row[3] for row in held)
        if count >= 300:
            time_s = sum(row[0] * row[3] for row in held) / count
            out.append((time_s, sum(row[1] * row[3] for row in held) / count, held[0][2]))
        held.clear()

    for row in recording.blocks:
        if held and (row[2] != held[0][2] or row[0] - held[-1][0] > 0.005):
            close()
        if row[2] not in (0, low_ticks):
            held.append(row)
    close()
    return out


def points_of(recording: Recording, beta: Array, centre: float, half: float, bin_c: float = 4.0) -> Points:
    """Calibration points: every visit, and the minimum phase in bins of temperature."""
    time_s, error = _low_rows(recording)
    low_ticks = phase_low(recording)
    skin_c = np.polynomial.polynomial.polyval((error - centre) / half, beta)
    rows = [
        (float(np.interp(at_s, time_s, skin_c)), float(phase), value)
        for at_s, value, phase in _visits(recording)
    ]
    if len(rows) < 40:
        raise FitError(f"the recording holds only {len(rows)} visits to higher powers")
    bins = np.floor(skin_c / bin_c)
    for index in np.unique(bins):
        mask = bins == index
        rows.append((float(skin_c[mask].mean()), float(low_ticks), float(error[mask].mean())))
    return Points(*(np.array(column) for column in zip(*rows, strict=True)))


def _residuals(found: fit_sensing.Regression, table: LawTable | None, points: Points) -> Array:
    if table is None:
        return fit_sensing.temperature_residuals(found.law, found.values(), points)
    return fit_table.residuals(found.values(), table, points)


def _fitted(name: str, points: Points) -> tuple[fit_sensing.Regression, LawTable | None]:
    """`table`: the tank law with a table beside it."""
    if name != "table":
        return fit_sensing.FITTERS[name](points), None
    found = fit_sensing.FITTERS["tank"](points)
    return found, fit_table.fit(found.values(), points)


def judge(name: str, points: Points) -> LawFigures:
    """Fit a law to two thirds of the points for the figures, and to all of them for use."""
    index = np.arange(len(points))
    train, test = points.where(index % HELD_OUT != 0), points.where(index % HELD_OUT == 0)
    residual = _residuals(*_fitted(name, train), test)
    usable = np.where(np.isfinite(residual), residual, 1e3)
    inside = (test.temp_c >= 50.0) & (test.temp_c <= 350.0)
    work = usable[inside & (test.power <= WORKING_POWER)]
    if not work.size:
        raise FitError("the recording holds no points at up to 20 % power between 50 and 350 C")
    return LawFigures(
        *_fitted(name, points),
        float(np.abs(work).max()),
        float(np.sqrt(np.mean(work**2))),
        float(np.sqrt(np.mean(usable[inside] ** 2))),
        float(np.abs(usable[inside]).max()),
    )


def _mean_power(recording: Recording, law: DriveLaw, grid_s: Array) -> Array:
    """Heat in each grid cell, W."""
    edges = np.append(grid_s, grid_s[-1] + (grid_s[1] - grid_s[0]))
    rows = np.array(recording.blocks)
    # What lies between two blocks is the settling after the step to the second one's phase.
    end = rows[:, 0] + 0.5 * rows[:, 4]
    times = np.concatenate([[rows[0, 0] - 0.5 * rows[0, 4]], end])
    watts = {phase: law.power_w(phase) for phase in np.unique(rows[:, 2])}
    power = np.array([watts[phase] for phase in rows[:, 2]])
    energy_at = np.concatenate([[0.0], np.cumsum(power * np.diff(times))])
    return np.asarray(np.diff(np.interp(edges, times, energy_at)) / np.diff(edges))


def fit_heat(
    recording: Recording, law: DriveLaw, beta: Array, centre: float, half: float
) -> tuple[float, float, float, float, float]:
    """(capacity at 25 degC, loss factor, second mass factor, ambient, rms residual in degC) of the two-node model."""
    time_s, error = _low_rows(recording)
    skin_c = np.polynomial.polynomial.polyval((error - centre) / half, beta)
    step_s = 0.1
    grid_s = np.arange(time_s[0], time_s[-1] - step_s, step_s)
    wanted = np.interp(grid_s, time_s, skin_c)
    power_w = _mean_power(recording, law, grid_s)
    # The reference before the looks have warmed the nozzle.
    ambient_c = float(np.median([c for t, c in recording.reference if t < recording.reference[0][0] + 1.0]))

    def run(x: Array) -> Array:
        heat, loss = (
            heat_loss.HeatCapacity(float(x[0])),
            heat_balance_monitor.scaled(float(x[1]), ambient_c, float(x[2])),
        )
        skin, second = float(wanted[0]), ambient_c
        out = np.empty_like(wanted)
        for i, watts in enumerate(power_w):
            out[i] = skin
            rate = (watts - loss.skin_out_w(skin, second)) / heat.at(skin)
            second_rate = loss.second_rate(skin, second)
            middle, middle2 = skin + 0.5 * step_s * rate, second + 0.5 * step_s * second_rate
            skin += step_s * (watts - loss.skin_out_w(middle, middle2)) / heat.at(middle)
            second += step_s * loss.second_rate(middle, middle2)
        return np.asarray(out - wanted)

    limits = ([0.05, 0.1, 0.1], [8.0, 10.0, 10.0])
    solution = optimize.least_squares(run, [0.414, 1.0, 1.0], bounds=limits, diff_step=1e-3)
    residual = float(np.sqrt(np.mean(solution.fun**2)))
    capacity, loss_factor, second = (float(v) for v in solution.x)
    return capacity, loss_factor, second, ambient_c, residual


REFERENCE_EVERY_S = 0.1


def read_recording(path: Path) -> Recording:
    """The recording back from a trace file. Raises FitError."""
    columns = read_columns(path)
    missing = [name for name in COLUMNS if name not in columns]
    if missing:
        raise FitError(f"{path}: not the trace of a calibration run, it has no {', '.join(missing)}")
    time_s, reference_c, error, phase, count, duration = (columns[name] for name in COLUMNS)
    recording = Recording()
    recording.blocks = [
        (float(t), float(e), int(n), int(c), float(d))
        for t, e, n, c, d in zip(time_s, error, phase, count, duration, strict=True)
    ]
    ticks = np.arange(time_s[0], time_s[-1], REFERENCE_EVERY_S)
    readings = np.interp(ticks, time_s, reference_c)
    recording.reference = [(float(t), float(c)) for t, c in zip(ticks, readings, strict=True)]
    with path.open(encoding="utf-8") as stream:
        marked = [line[len(READING_MARK) :].split(",") for line in stream if line.startswith(READING_MARK)]
    if marked:
        recording.reference = [(float(t), float(c)) for t, c in marked]
    return recording


def analyse(recording: Recording, drive: DriveLaw, gain: float = 1.0) -> Calibration:
    """All steps of the fit. Raises FitError with a text for people."""
    lag, beta, centre, half = estimate_lag(recording, gain)
    points = points_of(recording, beta, centre, half)
    laws = {name: judge(name, points) for name in fit_sensing.FITTERS}
    with contextlib.suppress(FitError):
        laws["table"] = judge("table", points)
    best = choose(laws)
    capacity, loss_factor, second, ambient_c, residual = fit_heat(recording, drive, beta, centre, half)
    return Calibration(lag, points, laws, best, capacity, loss_factor, second, ambient_c, residual)


def choose(laws: dict[str, LawFigures]) -> str:
    """The law that fits held-out points best; a table must be worth its numbers."""
    plain = min((name for name in laws if name != "table"), key=lambda name: laws[name].held_out_rms_c)
    if "table" not in laws:
        return plain
    is_worth = laws["table"].held_out_rms_c < TABLE_WORTH * laws[plain].held_out_rms_c
    return "table" if is_worth else plain


def report(result: Calibration) -> list[str]:
    """Lines for people."""
    points, lag = result.points, result.lag
    lines = [
        f"{len(points)} points, {points.temp_c.min():.0f} to {points.temp_c.max():.0f} C,"
        f" {np.unique(points.phase_ticks).size} powers",
        f"reference: lag {lag.tau_s:.2f} s (readings within {lag.residual_c:.2f} C rms of it),"
        f" gain {lag.gain:.3f} as given: a run cannot determine it",
        "held-out points, 50-350 C:   up to 20 % power          any power",
    ]
    for name, figures in sorted(result.laws.items(), key=lambda item: item[1].held_out_rms_c):
        mark = " <- chosen" if name == result.best else ""
        lines.append(
            f"  {name:<6} max {figures.held_out_max_c:6.2f} C  rms {figures.held_out_rms_c:5.2f} C"
            f"   max {figures.all_powers_max_c:6.2f} C{mark}"
        )
    residual = result.laws[result.best].residuals(points)
    for ticks in np.unique(points.phase_ticks):
        mask = points.phase_ticks == ticks
        power_pct = 100 * float(fit_sensing.power_of_ticks(ticks))
        lines.append(
            f"  {power_pct:5.1f} %: rms {np.sqrt(np.mean(residual[mask] ** 2)):.2f} C,"
            f" max {np.abs(residual[mask]).max():.2f} C"
        )
    lines.append(
        f"heat: capacity {result.capacity_j_k:.3f} J/K, losses {result.loss_factor:.2f} times the reference"
        f" nozzle's (model within {result.heat_residual_c:.1f} C rms)"
    )
    return lines


def summary(result: Calibration) -> dict[str, Any]:
    """The result as plain values."""
    found = result.laws[result.best]
    chosen, table = found.regression, found.table
    low_c = found.residuals(result.points)[result.points.phase_ticks == result.points.phase_ticks.min()]
    left_units = float(np.sqrt(np.mean(low_c**2))) if table is not None else chosen.residual_sd
    return {
        "law": chosen.law,
        "coefficients": chosen.values(),
        "table": table.rows() if table is not None else None,
        "residual_units": max(0.02, left_units),
        "capacity_j_k": result.capacity_j_k,
        "loss_factor": result.loss_factor,
        "second_factor": result.second_factor,
        "ambient_c": result.ambient_c,
        "lag_s": result.lag.tau_s,
        "phase_low_ticks": int(result.points.phase_ticks.min()),
        "held_out_max_c": {name: figures.held_out_max_c for name, figures in result.laws.items()},
        "report": report(result),
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("trace", type=Path)
    default = DriveLaw()
    parser.add_argument("--gain", type=float, default=1.0, help="of the reference sensor (Table 6)")
    parser.add_argument("--power-full", type=float, default=default.power_full_w, help="W at full phase")
    parser.add_argument("--exponent", type=float, default=default.exponent)
    options = parser.parse_args(argv)
    drive = DriveLaw(options.power_full, options.exponent)
    try:
        result = analyse(read_recording(options.trace), drive, options.gain)
    except (FitError, OSError, ValueError) as error:
        print(f"fit_sweep: {error}", file=sys.stderr)
        return 2
    print(json.dumps(summary(result)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
