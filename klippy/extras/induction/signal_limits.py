"""Limits of the MCU's tests of the signal (src/signal_test.h), in its units, from the front end and the coil's phase.

The signal is the phase of the coil current, `gain` units a degree. Sampled later by t it reads gain * 360 * f * t units
more, at any temperature and drive: 85 units for 7 ticks of 72 MHz at 120 kHz. The board learns how far its own signal
moves; here are the bounds of what it may learn. A calibration measures the gain, and the bounds are narrow from then
on. A gain 10 % off reads 25 degC wrong at 250 degC.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from thermal.sensing.features import FeatureParameters

GAIN_UNITS_DEG = 20.136  # Oskolkov 2021, Table 1
GAIN_RANGE = 3.0  # what an amplifier may be built with, either way
MEASURED_TOLERANCE = 0.15  # of a gain that was measured: parts age and warm
LEARNED_TOLERANCE = 0.08  # of what this board has learned since it was started
SLACK_LSB = 1.0  # three sigma of 16 samples with 1 LSB of noise, and a beat of 5 LSB
OFF_UNITS, OFF_LSB = 10.0, 6.0  # no current: this far from the zero, whichever is more
JUMP_UNITS, JUMP_LSB = 15.0, 4.0  # from block to block, likewise
UNITS_PER_C = 0.85  # the laws' slope at the smallest drive, the steepest
RISE_C_S = 2000.0  # 300 W into 0.33 g of steel
FALL_C_S = 20.0
RATE_SAMPLES = 64  # of src/signal_test.h
STILL_BLOCKS = 4


@dataclass(frozen=True, slots=True)
class SignalLimits:
    """As config_induction_test takes them."""

    moved_low: int  # 1/16 LSB
    moved_high: int
    tolerance: int  # 1/256 of what the board has learned
    slack: int  # 1/16 LSB
    off_low: int  # LSB
    off_high: int
    interval: int  # samples from test to test
    phase: int  # below it nothing is tested
    jump: int  # 1/16 LSB
    rise: int  # 1/16 LSB in 64 samples
    fall: int


def moved_lsb(front: FeatureParameters, frequency_hz: float, gain_units_deg: float, moved_s: float) -> float:
    """How far the signal moves when the sampling instant does."""
    return gain_units_deg * 360.0 * frequency_hz * moved_s / front.units_per_lsb


def off_lsb(front: FeatureParameters) -> float:
    """Without current the signal is no farther from its zero."""
    return max(OFF_UNITS / front.units_per_lsb, OFF_LSB)


def seen_cause(blocks: Sequence[Any], front: FeatureParameters) -> str:
    """What the last blocks before a trip show of its cause, "" if nothing."""
    last = [block for block in blocks if block.phase_ticks][-STILL_BLOCKS:]
    if last and abs(last[-1].mean_raw - front.adc_zero_raw) <= off_lsb(front):
        return "the coil's signal was that of no current: coil, bridge, its supply or sensing lead open"
    if len(last) == STILL_BLOCKS and {code for b in last for code in (b.min_raw, b.max_raw)} == {
        last[0].min_raw
    }:
        return "the coil's signal stands still"
    return ""


def signal_limits(
    front: FeatureParameters,
    frequency_hz: float,
    interval_s: float,
    gain_units_deg: float | None,
    moved_s: float,
    phase_ticks: int,
) -> SignalLimits:
    """`gain_units_deg`: as measured. `moved_s`: by how much the board moves its sampling instant; 0: it cannot.
    `phase_ticks`: below it nothing is tested.
    """
    lsb_per_unit = 1.0 / front.units_per_lsb
    far = moved_lsb(front, frequency_hz, gain_units_deg or GAIN_UNITS_DEG, moved_s)
    low, high = far / GAIN_RANGE, far * GAIN_RANGE
    if gain_units_deg is not None:
        low = far * (1.0 - MEASURED_TOLERANCE) - SLACK_LSB
        high = far * (1.0 + MEASURED_TOLERANCE) + SLACK_LSB
    off = off_lsb(front)
    rate_lsb = UNITS_PER_C * lsb_per_unit * RATE_SAMPLES / frequency_hz
    return SignalLimits(
        max(0, math.floor(16.0 * low)),
        min(0xFFFF, math.ceil(16.0 * high)) if moved_s else 0,
        round(256.0 * LEARNED_TOLERANCE),
        round(16.0 * SLACK_LSB),
        max(0, math.floor(front.adc_zero_raw - off)),
        math.ceil(front.adc_zero_raw + off),
        round(interval_s * frequency_hz),
        phase_ticks,
        math.ceil(16.0 * max(JUMP_UNITS * lsb_per_unit, JUMP_LSB)),
        math.ceil(16.0 * RISE_C_S * rate_lsb),
        math.ceil(16.0 * FALL_C_S * rate_lsb),
    )
