"""SampleBlock to Features.

Raw codes to error units, phase to power fraction, and what makes a block unusable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from .records import PHASE_MAX_TICKS, Features, SampleBlock

QUANTISATION_VARIANCE = 1.0 / 12.0  # LSB^2, a uniform rounding error


@dataclass(frozen=True, slots=True)
class FeatureParameters:
    """The analogue front end: what one ADC code means."""

    adc_zero_raw: float = 256.0  # code of error 0 (25 degC, source 000 section 3.1)
    units_per_lsb: float = 1.0
    noise_lsb: float = 1.0  # standard deviation of one sample
    adc_max_raw: int = 4095
    phase_max_ticks: int = PHASE_MAX_TICKS


def power_fraction(phase_ticks: float, phase_max_ticks: int = PHASE_MAX_TICKS) -> float:
    """p of the sensing laws: source 000's power percentage / 100 = (ifi/45000)^2."""
    ratio = phase_ticks / phase_max_ticks
    return ratio * ratio


def extract(parameters: FeatureParameters, block: SampleBlock) -> Features:
    """Features of one block. Nothing is filtered here: each block keeps its own phase."""
    noise_lsb = math.sqrt((parameters.noise_lsb * parameters.noise_lsb + QUANTISATION_VARIANCE) / block.count)
    fault = ""
    if block.phase_ticks == 0:
        fault = "bridge off"
    elif block.min_raw <= 0 or block.max_raw >= parameters.adc_max_raw:
        fault = "signal clipped"
    elif block.lost:
        fault = "samples lost"
    return Features(
        block.time_s + 0.5 * block.duration_s,
        (block.mean_raw - parameters.adc_zero_raw) * parameters.units_per_lsb,
        noise_lsb * parameters.units_per_lsb,
        block.phase_ticks,
        power_fraction(block.phase_ticks, parameters.phase_max_ticks),
        block.count,
        fault,
    )
