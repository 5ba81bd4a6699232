"""The charts of a report: which columns of the trace stand in which panel. The page and the picture draw the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .data import SETTLED_BAND_C, Floats, Times, Trace, envelope, head_speed

MERGED_S = 1.0  # stretches beyond the scale that are nearer than this share a mark


@dataclass(frozen=True, slots=True)
class Series:
    """One line of a chart: `column` of the trace, or `column` minus `minus`. `colour`: a name of page.css."""

    column: str
    label: str
    colour: str
    minus: str = ""
    shown: bool = True
    dashed: bool = False

    def values(self, trace: Trace) -> Floats | None:
        """None if the trace does not have it. Without a target nothing is far from it."""
        column = head_speed(trace) if self.column == "speed_mm_s" else getattr(trace, self.column)
        if column is None or np.isnan(column).all():
            return None
        if not self.minus:
            return column
        other = getattr(trace, self.minus)
        return np.where(other > 0.0, column - other, np.float32(np.nan))


@dataclass(frozen=True, slots=True)
class Chart:
    """One panel, its series in the order of drawing. The scale ends at ±`limit`; what is beyond is marked."""

    title: str
    unit: str
    height_px: int
    series: tuple[Series, ...]
    limit: float | None = None
    from_zero: bool = False


@dataclass(frozen=True, slots=True)
class Line:
    """A series thinned for drawing. `cuts`: (from s, to s, +1 above or -1 below) where the scale cuts it."""

    series: Series
    t_s: Times
    values: Floats
    cuts: Sequence[tuple[float, float, int]]


CHARTS = (
    Chart(
        "Temperature",
        "°C",
        300,
        (
            Series("melt_c", "melt at the outlet", "melt"),
            Series("bore_c", "bore", "bore", shown=False),
            Series("estimate_c", "estimate", "estimate"),
            Series("true_c", "true (nozzle skin)", "true"),
            Series("target_c", "target (the plan)", "target", dashed=True),
        ),
    ),
    Chart(
        "Temperature error",
        "°C",
        210,
        (
            Series("estimate_c", "estimate − target", "estimate", minus="target_c"),
            Series("true_c", "true − target", "true", minus="target_c"),
            Series("estimate_c", "estimate − true", "bore", minus="true_c", shown=False),
        ),
        limit=2.0 * SETTLED_BAND_C,
    ),
    Chart(
        "What the host knows of its error",
        "°C",
        180,
        (
            Series("sigma_c", "sigma (standard deviation of the estimate)", "estimate"),
            Series("drift_c", "drift (by the heat balance)", "bore"),
        ),
    ),
    Chart("Supply, as the estimator has it", "share of nominal", 160, (Series("supply", "supply", "melt"),)),
    Chart("Power into the nozzle", "W", 180, (Series("power_w", "power", "power"),), from_zero=True),
    Chart(
        "Bridge phase, 45000 ticks = 180°",
        "ticks",
        180,
        (Series("phase_ticks", "phase", "phase"),),
        from_zero=True,
    ),
    Chart("Flow", "mm³/s", 180, (Series("flow_mm3_s", "flow", "flow"),), from_zero=True),
    Chart("Speed of the head", "mm/s", 180, (Series("speed_mm_s", "speed", "phase"),), from_zero=True),
    Chart(
        "Bed",
        "°C",
        180,
        (Series("bed_c", "bed", "true"), Series("bed_target_c", "target", "target", dashed=True)),
    ),
    Chart("Part fan", "0 to 1", 160, (Series("fan", "fan", "estimate"),), from_zero=True),
)


def lines(chart: Chart, trace: Trace, buckets: int) -> list[Line]:
    """The lines the trace has for a chart, each of up to two points a bucket."""
    result = []
    for series in chart.series:
        values = series.values(trace)
        if values is not None:
            t_s, thin = envelope(trace.t_s, values, buckets).line()
            result.append(Line(series, t_s, thin, cuts(t_s, thin, chart.limit)))
    return result


def cuts(t_s: Times, values: Floats, limit: float | None) -> list[tuple[float, float, int]]:
    """Where a line is beyond ±limit."""
    result: list[tuple[float, float, int]] = []
    if limit is None:
        return result
    for sign in (1, -1):
        rows = np.flatnonzero(sign * values > limit)
        gaps = np.flatnonzero(np.diff(t_s[rows]) > MERGED_S) + 1
        for first, end in pairwise([0, *gaps.tolist(), len(rows)]):
            if end > first:
                result.append((float(t_s[rows[first]]), float(t_s[rows[end - 1]]), sign))
    return result
