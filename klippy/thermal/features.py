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


# (noise of one sample, mean of highest minus lowest code of 192 samples), LSB: Gaussian noise, mean anywhere
# between two codes; recomputed by test/unit/test_thermal_features.py.
SPAN_SAMPLES = 192
SPAN_OF_NOISE = (
    (0.05, 0.28),
    (0.1, 0.54),
    (0.15, 0.82),
    (0.2, 1.09),
    (0.25, 1.37),
    (0.3, 1.63),
    (0.35, 1.91),
    (0.4, 2.19),
    (0.5, 2.74),
    (0.6, 3.28),
    (0.8, 4.36),
    (1.0, 5.47),
    (1.5, 8.19),
    (2.0, 10.96),
    (4.0, 21.81),
)
NOISE_NEEDED_LSB = 0.3  # less, and the mean of many samples no longer shows what lies between two codes
NOISE_BLOCKS = 200  # memory of the running mean: a third of a second


@dataclass(slots=True)
class NoiseState:
    """Running mean of the samples' span over whole blocks."""

    span_lsb: float = math.nan
    blocks: int = 0


def note_noise(state: NoiseState, block: SampleBlock) -> None:
    """Take the span of a block with the bridge on; short cut ones say too little."""
    if not block.phase_ticks or block.count < SPAN_SAMPLES // 2:
        return
    # A longer block spans more: expected extremes of n Gaussian samples go with sqrt(2 ln n).
    span = (block.max_raw - block.min_raw) * math.sqrt(math.log(SPAN_SAMPLES) / math.log(block.count))
    state.blocks = min(state.blocks + 1, NOISE_BLOCKS)
    state.span_lsb = span if state.blocks == 1 else state.span_lsb + (span - state.span_lsb) / state.blocks


def noise_lsb(state: NoiseState) -> float | None:
    """Standard deviation of one sample in LSB, from the mean span; None before enough blocks."""
    if state.blocks < NOISE_BLOCKS // 4:
        return None
    low_noise = low_span = 0.0
    for noise, span in SPAN_OF_NOISE:
        if state.span_lsb <= span:
            return low_noise + (noise - low_noise) * (state.span_lsb - low_span) / (span - low_span)
        low_noise, low_span = noise, span
    return state.span_lsb * low_noise / low_span


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
