"""Blocks to signal units: raw codes, phase to power fraction, and what makes a block unusable (pipeline.h).

    error = (mean - zero) units_per_lsb        noise = units_per_lsb sqrt((noise_lsb^2 + 1/12) / count + stuck)

stuck: samples without noise of their own fall on one code, and their mean says no more than each (pipeline.c).
Nothing is filtered here: each block keeps its own phase.
"""

from __future__ import annotations

from dataclasses import dataclass

import chelper
from thermal.records import PHASE_MAX_TICKS, Features

from .blocks import REASONS, Blocks


@dataclass(frozen=True, slots=True)
class FeatureParameters:
    """The analogue front end: what one ADC code means."""

    adc_zero_raw: float = 256.0  # code of error 0 (25 degC, Oskolkov 2021 section 3.1)
    units_per_lsb: float = 1.0
    noise_lsb: float = 1.0  # standard deviation of one sample
    adc_max_raw: int = 4095
    phase_max_ticks: int = PHASE_MAX_TICKS
    block_samples: int = 192  # of a whole block


# Highest minus lowest of 192 samples of Gaussian noise, expected, over its sigma. Whole codes do not change it: over
# all places between two codes rounding leaves the mean of a difference as it is (recomputed in test_thermal_filter.py).
SPAN_SAMPLES, SPAN_PER_NOISE = 192, 5.46
NOISE_NEEDED_LSB = 0.3  # less, and the mean of many samples no longer shows what lies between two codes
NOISE_BLOCKS = 200  # memory of the running mean: a third of a second


def power_fraction(phase_ticks: float, phase_max_ticks: int = PHASE_MAX_TICKS) -> float:
    """p of the sensing laws: Oskolkov 2021's power percentage / 100 = (ifi/45000)^2."""
    ratio = phase_ticks / phase_max_ticks
    return ratio * ratio


def front_params(parameters: FeatureParameters) -> dict[str, float]:
    """As C's struct front_params."""
    return {
        "adc_zero_raw": parameters.adc_zero_raw,
        "units_per_lsb": parameters.units_per_lsb,
        "noise_lsb": parameters.noise_lsb,
        "adc_max_raw": parameters.adc_max_raw,
    }


def extract(parameters: FeatureParameters, blocks: Blocks) -> list[Features]:
    """Features of each block, for who works without a sensing law: a calibration run."""
    ffi, lib = chelper.get_ffi()
    lib.front_measure(ffi.new("struct front_params *", front_params(parameters)), blocks.raw, blocks.count)
    return [
        Features(
            b.centre_s,
            b.signal_units,
            b.noise_units,
            b.phase_ticks,
            power_fraction(b.phase_ticks, parameters.phase_max_ticks),
            b.count,
            REASONS[b.fault],
        )
        for b in blocks.raw[0 : blocks.count]
    ]
