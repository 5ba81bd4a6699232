"""Autotune of a PID: the heater is switched around the target, and the swing identifies it.

    output  high ┐   ┌───┐      switched off `band_c` above the target, on `band_c` below it; "off" is `low`
            low  └───┘   └─     the first swings only settle, `cycles` of them are measured

From whole periods the first harmonics of temperature and output (Fourier integrals over the samples, so neither
peaks nor symmetry matter) give one point of the plant's frequency response, G(jw) = T1 / U1. Around the target every
heater is an integrator with a delay; that point determines both its numbers:

    G = k exp(-jw L) / (jw)      k = w |G|  (degC/s per output),   L = (-pi/2 - arg G) / w

An integrator with a delay oscillates at K_u = pi / (2 k L) with the period T_u = 4 L. Gains are Tyreus and Luyben's
(Ind. Eng. Chem. Res. 31, 2625, 1992), made for such plants: K_p = K_u / 2.2, T_i = 2.2 T_u, T_d = T_u / 6.3: little
overshoot, a gain margin above 2. Medians over the periods count, and their scatter is the uncertainty: where a message
between host and MCU is lost, one swing is switched late and shows a delay that the plant does not have.
"""

from __future__ import annotations

import cmath
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, TextIO

from .run import DONE, OutputPlan, OutputRun


class CalibrationError(ValueError):
    """A run cannot give a result; the text is for people."""


class Point(NamedTuple):
    """One reading, and the output in force (or about to be) from it on."""

    time_s: float
    temp_c: float
    output: float


@dataclass(frozen=True, slots=True)
class RelayPlan(OutputPlan):
    """How to swing."""

    cycles: int = 5  # measured, after one that settles
    swing_s: float = 300.0  # longest half of a cycle


GAIN_SIGMA, DELAY_SIGMA = 0.14, 0.2  # of the value: standard errors of the medians that make no useful tuning
HEAT, SWING = "heating", "swinging"


class RelayRun(OutputRun):
    """One run."""

    plan: RelayPlan

    def __init__(self, plan: RelayPlan) -> None:
        super().__init__(plan, HEAT)
        self.points: list[Point] = []
        self.rises: list[
            int
        ] = []  # index of the point at which the output was switched on, once at temperature
        self._output = plan.high
        self._since_s = math.nan  # of the present half

    @property
    def target_c(self) -> float:
        return self.plan.target_c if not self.over else 0.0

    def progress(self, temp_c: float) -> str:
        done = max(0, len(self.rises) - 2)
        doing = self.stage if self.stage == HEAT else f"swing {done} of {self.plan.cycles}"
        return f"{doing}, {temp_c:.1f} C"

    def write(self, stream: TextIO) -> None:
        stream.writelines(f"{p.time_s:.4f} {p.temp_c:.3f} {p.output:.4f}\n" for p in self.points)

    def decide(self, time_s: float, temp_c: float, limit: float = math.inf) -> float:
        if not self.over and not math.isnan(temp_c):
            self._check(time_s, temp_c)
        if self.over:
            return 0.0
        if not math.isnan(temp_c):
            self._switch(time_s, temp_c)
            if not self.over:
                self.points.append(Point(time_s, temp_c, min(limit, self._output)))
        return 0.0 if self.over else min(limit, self._output)

    def _check(self, time_s: float, temp_c: float) -> None:
        if not self.points:
            self._since_s = time_s
        self._check_heating(time_s, temp_c, self._output > 0.0)
        longest_s = self.plan.heat_s if self.stage == HEAT else self.plan.swing_s
        if time_s - self._since_s > longest_s:
            self.abort(f"it was still {self.stage} after {longest_s:.0f} s ({temp_c:.1f} C)")

    def _switch(self, time_s: float, temp_c: float) -> None:
        plan = self.plan
        if self._output and temp_c >= plan.target_c + plan.band_c:
            self._output, self._since_s, self.stage = 0.0, time_s, SWING
        elif not self._output and temp_c <= plan.target_c - plan.band_c:
            self._output, self._since_s = plan.high, time_s
            self.rises.append(len(self.points))
            if len(self.rises) > plan.cycles + 1:
                self.stage = DONE


@dataclass(frozen=True, slots=True)
class RelayResult:
    """Integrator and delay, 1 sigma of each, and the PID they ask for; gains per K, K s, K/s in output units."""

    gain_per_s: float  # k, degC/s per unit of output
    gain_sigma: float
    delay_s: float
    delay_sigma_s: float
    period_s: float
    swing_c: float  # peak to peak
    kp: float
    ki: float
    kd: float


def _harmonic(points: Sequence[Point], omega: float) -> tuple[complex, complex]:
    """First harmonics of temperature (straight lines between readings) and output (held from each reading on)."""
    temp, output = 0j, 0j
    mean_c = statistics.fmean(p.temp_c for p in points)
    for a, b in pairwise(points):
        dt_s = b.time_s - a.time_s
        middle = cmath.exp(-1j * omega * 0.5 * (a.time_s + b.time_s))
        temp += (0.5 * (a.temp_c + b.temp_c) - mean_c) * middle * dt_s
        output += (
            a.output * (cmath.exp(-1j * omega * a.time_s) - cmath.exp(-1j * omega * b.time_s)) / (1j * omega)
        )
    return temp, output


def _cycle(points: Sequence[Point]) -> tuple[float, float, float]:
    """(gain, delay, period) of one cycle."""
    period_s = points[-1].time_s - points[0].time_s
    omega = 2.0 * math.pi / period_s
    temp, output = _harmonic(points, omega)
    if abs(output) == 0.0:
        raise CalibrationError("the output did not swing")
    response = temp / output
    lag = -math.pi / 2.0 - cmath.phase(response)
    lag = (lag + math.pi) % (2.0 * math.pi) - math.pi
    return omega * abs(response), lag / omega, period_s


def _middle(values: Sequence[float]) -> tuple[float, float]:
    """(median, scatter of one value): 1.4826 median deviations are a standard deviation if it is normal."""
    middle = statistics.median(values)
    return middle, 1.4826 * statistics.median(abs(value - middle) for value in values)


def evaluate(run: RelayRun) -> RelayResult:
    """PID from a run that is done. Raises CalibrationError if the swings do not agree on one plant."""
    if run.stage != DONE:
        raise CalibrationError(run.fault or "the run is not over")
    points = [*run.points]
    spans = list(zip(run.rises[1:], run.rises[2:], strict=False))  # the first swing settles
    cycles = [_cycle(points[a : min(b + 1, len(points))]) for a, b in spans]
    if len(cycles) < 2:
        raise CalibrationError("too few swings")
    gains, delays, periods = (list(column) for column in zip(*cycles, strict=True))
    (gain, gain_scatter), (delay_s, delay_scatter_s) = _middle(gains), _middle(delays)
    root = math.sqrt(len(cycles) / (0.5 * math.pi))  # of a median
    sure = gain_scatter < GAIN_SIGMA * root * gain and delay_scatter_s < DELAY_SIGMA * root * delay_s
    if not (gain > 0.0 and delay_s > 0.0 and sure):
        raise CalibrationError(
            f"the swings differ too much for a tuning (gain {gain:.3g} +- {gain_scatter:.2g}, delay {delay_s:.3g} +-"
            f" {delay_scatter_s:.2g} s), as with a running fan or extruder, or a line to the board that loses messages"
        )
    measured = points[run.rises[1] :]
    swing_c = max(p.temp_c for p in measured) - min(p.temp_c for p in measured)
    ultimate, ultimate_s = math.pi / (2.0 * gain * delay_s), 4.0 * delay_s
    kp = ultimate / 2.2
    return RelayResult(
        gain,
        gain_scatter / root,
        delay_s,
        delay_scatter_s / root,
        statistics.median(periods),
        swing_c,
        kp,
        kp / (2.2 * ultimate_s),
        kp * ultimate_s / 6.3,
    )
