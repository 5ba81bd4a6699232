"""The line between system time and an MCU's clock, from the times of question and answer alone. Pure: no I/O.

One `get_clock` gives a clock value c that was read some time between sending and receiving. With the system's time t
and y = c/f_nominal - t (s), each answer bounds the true y at that time from both sides:

        y                    sent:      y <= high = c/f - t_sent        too high by the way there and its delay
        |   ^    ^                ^     <- highs
        |  ---------------------------  the line midway between ...
        |    v        v       v         <- lows
        |                    received:  y >= low = c/f - t_received     too low by the way back and its delay
        +----------------------------------- t

Delays (queues, interrupts, USB frames) only ever push the bounds apart, never together, and now and then there is
none. So the innermost answers count: two parallel lines run through the strip between highs and lows, as far apart as
possible, and the true line is midway. For one-sided noise their error falls with the
number of answers (1/n), that of a least squares fit with its root only. What remains is half the difference of the
shortest way there and back.

The crystal's slow drift bends the strip. Its curvature is taken from the slopes of the last minutes and straightened
out before the lines are fitted.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

WINDOW_S = 45.0  # older answers are forgotten
CRYSTAL_SIGMA = 100e-6  # frequency error of a clock source before anything is known (s/s)
DRIFT_SIGMA_PER_S = 3e-8  # how fast it changes: about 2 ppm a minute (s/s per s)
DRIFT_MAX_PER_S = 2e-7
FLOOR_S = 0.1e-6  # no fit is better than this: ticks, and rounding of times
REFIT_S = 0.3  # once the line is good, new answers are only collected for that long
SETTLE_S = 3.0  # ... until then every answer counts at once
SLOPE_PERIOD_S = 2.0  # between the slopes kept for the curvature
SLOPES = 90

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class ClockSample:
    """One answered get_clock, times in system seconds."""

    sent_s: float
    received_s: float
    clock: int

    @property
    def round_trip_s(self) -> float:
        return max(0.0, self.received_s - self.sent_s)

    @property
    def middle_s(self) -> float:
        return 0.5 * (self.sent_s + self.received_s)


@dataclass(frozen=True, slots=True)
class ClockLine:
    """clock = clock_0 + (system time - time_s) * freq."""

    time_s: float
    clock: float
    freq: float

    def clock_at(self, time_s: float) -> float:
        return self.clock + (time_s - self.time_s) * self.freq

    def time_of(self, clock: float) -> float:
        return self.time_s + (clock - self.clock) / self.freq


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


@dataclass(frozen=True, slots=True)
class StripFit:
    """y = offset_s + slope*x + curvature*x*x/2 with x the time since the last sample; `doubt_s`: of the offset."""

    offset_s: float
    slope: float
    doubt_s: float


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


def fit_clock_line(samples: Sequence[ClockSample], nominal_freq: float, curvature: float = 0.0) -> ClockLine:
    """The tangent at the last sample."""
    fit, last = fit_strip(samples, nominal_freq, curvature), samples[-1]
    return ClockLine(
        last.middle_s, last.clock + fit.offset_s * nominal_freq, nominal_freq * (1.0 + fit.slope)
    )


class ClockEstimator:
    """The samples of the last WINDOW_S and the line through them. Times and clocks are arguments."""

    def __init__(self, nominal_freq: float) -> None:
        self.nominal_freq = nominal_freq
        self.line = ClockLine(0.0, 0.0, nominal_freq)
        self.curvature = 0.0  # change of the relative frequency error (1/s)
        self._samples: deque[ClockSample] = deque()
        self._begin_s = math.inf
        self._next_fit_s = -math.inf
        self._slopes: deque[tuple[float, float, float]] = deque(
            maxlen=SLOPES
        )  # middle of the window, slope, doubt

    def add(self, sample: ClockSample) -> ClockLine:
        """Take an answer in; the best line now."""
        samples = self._samples
        samples.append(sample)
        now_s = sample.middle_s
        while samples[0].middle_s < now_s - WINDOW_S:
            samples.popleft()
        self._begin_s = min(self._begin_s, now_s)
        if now_s >= self._next_fit_s:
            self._fit(now_s)
        return self.line

    def _fit(self, now_s: float) -> None:
        self._next_fit_s = now_s + REFIT_S if now_s - self._begin_s > SETTLE_S else -math.inf
        samples = list(self._samples)
        last = samples[-1]
        fit = fit_strip(samples, self.nominal_freq, self.curvature)
        self.line = ClockLine(
            now_s, last.clock + fit.offset_s * self.nominal_freq, self.nominal_freq * (1.0 + fit.slope)
        )
        span_s = now_s - samples[0].middle_s
        if span_s < 0.5 * WINDOW_S:
            return
        middle_s = now_s - 0.5 * span_s
        if not self._slopes or middle_s > self._slopes[-1][0] + SLOPE_PERIOD_S:
            # the mean slope over the window: what curvature was assumed makes no difference to it
            mean_slope = fit.slope - 0.5 * self.curvature * span_s
            self._slopes.append((middle_s, mean_slope, 2.0 * fit.doubt_s / span_s))
            self.curvature = self._find_curvature()

    def _find_curvature(self) -> float:
        """How the slope changes: least squares, with a prior at what crystals do."""
        rows = self._slopes
        n = len(rows)
        mean_t = sum(t for t, _, _ in rows) / n
        mean_slope = sum(s for _, s, _ in rows) / n
        sigma = sum(d for _, _, d in rows) / n
        # neighbouring windows share most of their samples: they say little more than one
        independent = SLOPE_PERIOD_S / WINDOW_S
        sum_xx = independent * sum((t - mean_t) ** 2 for t, _, _ in rows)
        sum_xy = independent * sum((t - mean_t) * (s - mean_slope) for t, s, _ in rows)
        curvature = sum_xy / (sum_xx + (sigma / DRIFT_SIGMA_PER_S) ** 2)
        return min(max(curvature, -DRIFT_MAX_PER_S), DRIFT_MAX_PER_S)

    @property
    def shortest_round_trip_s(self) -> float:
        return min((s.round_trip_s for s in self._samples), default=0.0)
