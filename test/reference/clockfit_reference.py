"""The strip fit of link/clockfit.py in plain Python: what chelper/link/clockfit.c must give, bit by bit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from link.clockfit import CRYSTAL_SIGMA, FLOOR_S, ClockSample, StripFit

Point = tuple[float, float]


def _lower_hull(points: Sequence[Point]) -> list[Point]:
    """The corners that a string pulled tight below the points (in order of x) would touch."""
    hull: list[Point] = []
    for x, y in points:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2], hull[-1]
            if (y1 - y0) * (x - x0) < (y - y0) * (x1 - x0):
                break  # the last corner lies below the straight way past it: it stays
            hull.pop()
        hull.append((x, y))
    return hull


class _Chain:
    """A convex chain of corners, asked at rising x."""

    def __init__(self, corners: Sequence[Point]) -> None:
        self._corners = corners
        self._slopes = [
            (y1 - y0) / (x1 - x0) if x1 > x0 else 0.0 for (x0, y0), (x1, y1) in itertools.pairwise(corners)
        ]
        self._at = 0

    def look(self, x: float) -> tuple[float, float, float]:
        """(y, slope left of x, slope right of x); beyond the ends the slopes are infinite."""
        corners, slopes = self._corners, self._slopes
        while self._at < len(slopes) and corners[self._at + 1][0] <= x:
            self._at += 1
        k = self._at
        x0, y0 = corners[k]
        right = slopes[k] if k < len(slopes) else math.inf
        if x > x0:
            return y0 + right * (x - x0), right, right
        return y0, slopes[k - 1] if k else -math.inf, right


def widest_strip(highs: Sequence[Point], lows: Sequence[Point]) -> float:
    """Slope of the widest strip above all lows and below all highs (points in order of the same x; at least one).

    Where the hulls of both come closest, the strip leans on them: any slope that both hulls have there gives it the
    same width, and the middle one is taken. 0 if all slopes fit.
    """
    above = _lower_hull(highs)
    below = _lower_hull([(x, -y) for x, y in lows])  # mirrored: its slopes have the other sign
    over, under = _Chain(above), _Chain(below)
    narrowest, low, high = math.inf, -math.inf, math.inf
    for x in sorted({x for x, _ in above} | {x for x, _ in below}):
        top, top_left, top_right = over.look(x)
        bottom, bottom_left, bottom_right = under.look(x)
        if top + bottom < narrowest:
            narrowest = top + bottom
            low, high = max(top_left, -bottom_right), min(top_right, -bottom_left)
    ends = [slope for slope in (low, high) if math.isfinite(slope)]
    return sum(ends) / len(ends) if ends else 0.0


def fit_strip(samples: Sequence[ClockSample], nominal_freq: float, curvature: float = 0.0) -> StripFit:
    """The line midway in the strip of samples (oldest first, at least one)."""
    last = samples[-1]
    base_s = last.middle_s
    highs, lows = [], []
    for p in samples:
        x = p.middle_s - base_s
        # relative to the last sample: 64-bit clocks do not fit a double's ns
        y = (p.clock - last.clock) / nominal_freq - 0.5 * curvature * x * x
        highs.append((x, y - (p.sent_s - base_s)))
        lows.append((x, y - (p.received_s - base_s)))
    slope = widest_strip(highs, lows)
    span_s = -highs[0][0]
    top, bottom = _edges(highs, lows, slope)
    strewn_s = sum(y - slope * x for x, y in highs) / len(highs) - top
    strewn_s += bottom - sum(y - slope * x for x, y in lows) / len(lows)
    doubt_s = FLOOR_S + 2.0 * strewn_s / len(samples)
    # what little the first fraction of a second says about the frequency counts less than what crystals are like
    slope /= 1.0 + (doubt_s / (span_s * CRYSTAL_SIGMA)) ** 2 if span_s > 0.0 else math.inf
    top, bottom = _edges(highs, lows, slope)
    return StripFit(0.5 * (top + bottom), slope, doubt_s)


def _edges(highs: Sequence[Point], lows: Sequence[Point], slope: float) -> tuple[float, float]:
    """Upper and lower edge, at x = 0, of the strip with this slope."""
    return min(y - slope * x for x, y in highs), max(y - slope * x for x, y in lows)
