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

import math
import struct
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import chelper

WINDOW_S = 45.0  # older answers are forgotten
CRYSTAL_SIGMA = 100e-6  # frequency error of a clock source before anything is known (s/s)
DRIFT_SIGMA_PER_S = 3e-8  # how fast it changes: about 2 ppm a minute (s/s per s)
DRIFT_MAX_PER_S = 2e-7
FLOOR_S = 0.1e-6  # no fit is better than this: ticks, and rounding of times
REFIT_S = 0.3  # once the line is good, new answers are only collected for that long
SETTLE_S = 3.0  # ... until then every answer counts at once
SLOPE_PERIOD_S = 2.0  # between the slopes kept for the curvature
SLOPES = 90

_SAMPLE = struct.Struct("=ddq")  # struct clock_sample


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


@dataclass(frozen=True, slots=True)
class StripFit:
    """y = offset_s + slope*x + curvature*x*x/2 with x the time since the last sample; `doubt_s`: of the offset."""

    offset_s: float
    slope: float
    doubt_s: float


def fit_strip(samples: Sequence[ClockSample], nominal_freq: float, curvature: float = 0.0) -> StripFit:
    """The line midway in the strip of samples (oldest first, at least one). chelper/link/clockfit.c does it."""
    ffi, lib = chelper.get_ffi()
    packed = b"".join([_SAMPLE.pack(p.sent_s, p.received_s, p.clock) for p in samples])
    room = ffi.new("double[]", lib.CLOCKFIT_ROOM * len(samples))
    rows = ffi.from_buffer("struct clock_sample[]", packed)
    fit = lib.clockfit_strip(rows, len(samples), nominal_freq, curvature, FLOOR_S, CRYSTAL_SIGMA, room)
    return StripFit(fit.offset_s, fit.slope, fit.doubt_s)


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
