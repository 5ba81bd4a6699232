"""The table beside the tank law: what the law leaves of the calibration points, smooth over temperature at each drive.

Each visited drive has its own row of values at common temperatures, found by least squares with a penalty on their
second differences. The penalty is weighed by the points' own scatter, so that noise is not followed. Offline: numpy.
"""

from __future__ import annotations

import numpy as np

from thermal.sensing import laws

from . import fit_sensing
from .fit_sensing import Array, FitError, Points

SMOOTH_C = 8.0  # 1 sigma of a second difference between nodes some 45 degC apart
SCATTER_C = 0.3  # minimum, of a point
POINTS_MIN = 4  # of a drive; one with fewer has no row
SLOPE_MIN = 0.15  # of the reading over the tank law's temperature; less says nothing of the temperature
PASSES = 3


def _hats(temp_c: Array, nodes_c: Array) -> Array:
    """Shares of the nodes at each temperature, shape (points, nodes)."""
    return np.column_stack([np.interp(temp_c, nodes_c, row) for row in np.eye(nodes_c.size)])


def _row(temp_c: Array, left_c: Array, nodes_c: Array) -> Array:
    """Values at the nodes that explain `left_c`."""
    hats = _hats(temp_c, nodes_c)
    bends = np.diff(np.eye(nodes_c.size), n=2, axis=0) / SMOOTH_C
    scatter_c = 1.0
    for _ in range(PASSES):
        design = np.vstack([hats / scatter_c, bends])
        wanted = np.concatenate([left_c / scatter_c, np.zeros(len(bends))])
        values = np.asarray(np.linalg.lstsq(design, wanted, rcond=None)[0])
        left = np.abs(left_c - hats @ values)
        scatter_c = max(SCATTER_C, 1.4826 * float(np.median(left)))
    return values


def _error_c(left_c: Array) -> float:
    """1 sigma of the law's error: what is left beyond the scatter of a visit."""
    return float(max(0.0, float(np.mean(left_c**2)) - SCATTER_C**2) ** 0.5)


def fit(values: dict[str, float], points: Points) -> laws.LawTable:
    """The table beside the tank law of these coefficients. Raises FitError."""
    tank_c = fit_sensing.invert("tank", values, points.error, points.phase_ticks)
    known = np.isfinite(tank_c)
    if np.mean(known) < 0.97:
        raise FitError("the tank law has no answer at many points")
    nodes_c = np.linspace(float(tank_c[known].min()), float(tank_c[known].max()), laws.NODES_MAX)
    levels, rows, errors = [], [], []
    for ticks in np.unique(points.phase_ticks):
        mask = known & (points.phase_ticks == ticks)
        if int(mask.sum()) < POINTS_MIN:
            continue
        left_c = points.temp_c[mask] - tank_c[mask]
        row = _row(tank_c[mask], left_c, nodes_c)
        if np.any(np.diff(nodes_c + row) < SLOPE_MIN * np.diff(nodes_c)):
            percent = 100.0 * float(fit_sensing.power_of_ticks(ticks))
            raise FitError(f"at {percent:.1f} % power the signal does not rise with the temperature")
        levels.append(float(ticks))
        rows.append(tuple(float(value) for value in row))
        errors.append(_error_c(left_c - _hats(tank_c[mask], nodes_c) @ row))
    return laws.LawTable(tuple(levels), tuple(float(c) for c in nodes_c), tuple(rows), tuple(errors))


def residuals(values: dict[str, float], table: laws.LawTable, points: Points) -> Array:
    """Inverted minus reference temperature at each point, degC."""
    law = laws.law_of("tank", values, table=table)
    pairs = zip(points.error, points.phase_ticks, strict=True)
    return np.array([law.invert(float(e), float(n))[0] for e, n in pairs]) - points.temp_c
