"""Error units at a known phase to temperature: two laws, both inverted in closed form.

`ExpLaw` (default), fitted to Table 1 of source 000 with p = (phase/45000)^2:

    error = a T exp(-b p) + c + d p          =>  T = (error - c - d p) / (a exp(-b p))

`Eq5Law`, eq 5 of source 000 with the coefficients of its Table 2, i = phase in ticks:

    error = A T + B i + AB T i + BB i^2 + ABB T i^2 + C
                                             =>  T = (error - C - B i - BB i^2) / (A + AB i + ABB i^2)

Both are straight lines in T at a fixed phase, so a law is two functions of the phase, `offset` and `slope`.
Each block is converted with its own phase; filtering raw error across a phase step would give spikes of
hundreds of degrees. What falls outside the range a law was fitted on is invalid and never a number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from .features import power_fraction
from .records import PHASE_MAX_TICKS, Features, TempEstimate

# 0.2 % power, the smallest of Table 1: least excitation the laws were fitted on.
SENSING_PHASE_TICKS = 2012


class Law(Protocol):
    """A sensing law, linear in temperature at each phase."""

    @property
    def residual_units(self) -> float:
        """Standard deviation of the fit, error units."""
        ...

    def line(self, phase_ticks: float) -> tuple[float, float]:
        """(offset in units, slope in units per degC) at this phase."""
        ...


@dataclass(frozen=True, slots=True)
class ExpLaw:
    """error = a T exp(-b p) + c + d p. Coefficients: four-parameter fit of Table 1, s = 0.975 units."""

    a: float = 0.801361
    b: float = 1.058014
    c: float = 1.397019
    d: float = 5.139702
    residual_units: float = 0.975
    phase_max_ticks: int = PHASE_MAX_TICKS

    def line(self, phase_ticks: float) -> tuple[float, float]:
        p = power_fraction(phase_ticks, self.phase_max_ticks)
        return self.c + self.d * p, self.a * math.exp(-self.b * p)


@dataclass(frozen=True, slots=True)
class Eq5Law:
    """Eq 5 of source 000, coefficients of Table 2.

    Residual 4.5-4.8 units, hence 6 degC at low power at best.
    """

    a: float = 0.825
    b: float = 0.0001081
    ab: float = -7.085e-06
    bb: float = 4.951e-10
    abb: float = -1.207e-10
    c: float = 0.797
    residual_units: float = 4.65

    def line(self, phase_ticks: float) -> tuple[float, float]:
        i = phase_ticks
        return self.c + (self.b + self.bb * i) * i, self.a + (self.ab + self.abb * i) * i


@dataclass(frozen=True, slots=True)
class EstimatorParameters:
    """A law and the range in which it may be believed."""

    law: Law
    temp_low_c: float = (
        -20.0
    )  # Table 1 begins at 110, the text at 20 degC: some room for noise and a cold workshop
    temp_high_c: float = 760.0  # Table 1 ends at 750 degC
    phase_low_ticks: int = SENSING_PHASE_TICKS


def error_of(law: Law, temp_c: float, phase_ticks: float) -> float:
    """The law forwards: error units at a temperature and phase."""
    offset, slope = law.line(phase_ticks)
    return offset + slope * temp_c


def _invalid(features: Features, reason: str) -> TempEstimate:
    nan = math.nan
    return TempEstimate(features.time_s, nan, nan, nan, nan, features.phase_ticks, False, reason)


def estimate(parameters: EstimatorParameters, features: Features) -> TempEstimate:
    """Temperature of one block with derivative and 1-sigma uncertainty, or invalid with a reason."""
    if features.fault:
        return _invalid(features, features.fault)
    if features.phase_ticks < parameters.phase_low_ticks:
        return _invalid(features, "too little excitation")
    law = parameters.law
    offset, slope = law.line(features.phase_ticks)
    if not slope > 0.0:
        return _invalid(features, "the sensing law has no slope at this phase")
    inverse = 1.0 / slope
    temp_c = (features.error_units - offset) * inverse
    if not parameters.temp_low_c <= temp_c <= parameters.temp_high_c:
        return _invalid(features, "outside the range of the sensing law")
    sigma_c = math.hypot(features.noise_units, law.residual_units) * inverse
    return TempEstimate(
        features.time_s,
        temp_c,
        sigma_c,
        features.noise_units * inverse,
        inverse,
        features.phase_ticks,
        True,
        "",
    )


def combine(estimates: list[TempEstimate]) -> TempEstimate | None:
    """One estimate of several neighbouring blocks: mean in temperature, weighted by the random variance.

    The law's residual is common to all and does not shrink. None if no estimate is valid.
    """
    valid = [e for e in estimates if e.valid]
    if len(valid) <= 1:
        return valid[0] if valid else None
    weights = [1.0 / (e.sigma_noise_c * e.sigma_noise_c) for e in valid]
    total = sum(weights)
    temp_c = sum(w * e.temp_c for w, e in zip(weights, valid, strict=True)) / total
    time_s = sum(w * e.time_s for w, e in zip(weights, valid, strict=True)) / total
    noise_c = total**-0.5
    last = valid[-1]
    law_variance = last.sigma_c * last.sigma_c - last.sigma_noise_c * last.sigma_noise_c
    sigma_c = math.sqrt(max(0.0, law_variance) + noise_c * noise_c)
    return TempEstimate(time_s, temp_c, sigma_c, noise_c, last.dtemp_derror, last.phase_ticks, True, "")
