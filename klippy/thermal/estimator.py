"""Features of one block to a temperature with its uncertainty, by a sensing law (laws.py).

Each block is converted with its own phase; filtering raw error across a phase step would give spikes of hundreds of
degrees. What falls outside the range a law may be believed in is invalid and never a number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from .laws import Eq5Law, ExpLaw, Law, TankLaw
from .records import Features, TempEstimate

__all__ = ["Eq5Law", "EstimatorParameters", "ExpLaw", "Law", "TankLaw", "combine", "error_of", "estimate"]

# 0.2 % power, the smallest of Table 1: least excitation the laws were fitted on.
SENSING_PHASE_TICKS = 2012

# Far beyond the range the signal is not that of a nozzle that is merely hot: an empty coil reads much higher.
EMPTY_MARGIN_C = 150.0


@dataclass(frozen=True, slots=True)
class EstimatorParameters:
    """A law and the range in which it may be believed."""

    law: Law
    temp_low_c: float = (
        -20.0
    )  # Table 1 begins at 110, the text at 20 degC: some room for noise and a cold workshop
    temp_high_c: float = 760.0  # Table 1 ends at 750 degC
    phase_low_ticks: int = SENSING_PHASE_TICKS
    supply: float = 1.0  # bridge voltage over the one the law was taken at


def error_of(law: Law, temp_c: float, phase_ticks: float) -> float:
    """The law forwards: error units at a temperature and phase."""
    return law.error(temp_c, phase_ticks)


def _why_outside(parameters: EstimatorParameters, features: Features) -> str:
    """Name what a reading outside the range looks like."""
    above = parameters.law.error(
        parameters.temp_high_c + EMPTY_MARGIN_C, features.phase_ticks, parameters.supply
    )
    if features.error_units > above:
        return "signal far above any nozzle's: is the nozzle missing from the coil?"
    return "outside the range of the sensing law: wrong nozzle, or its thermometer is not calibrated?"


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
    temp_c, inverse = law.invert(features.error_units, features.phase_ticks, parameters.supply)
    if not parameters.temp_low_c <= temp_c <= parameters.temp_high_c:
        return _invalid(features, _why_outside(parameters, features))
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
