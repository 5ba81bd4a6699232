"""The published chain, kept as a reference for benches: filter the raw error, then invert.

Oskolkov 2021, section 2.3: 4^y samples are summed whatever the drive does meanwhile (eq 2), an exponential moving
average runs over the sums (eqs 3 and 4), and the result is inverted with the phase of the moment (eq 5). A phase
step moves the error by tens of units in an instant; the filtered error follows late, the phase at once, so the
temperature jumps.
The product converts each block with its own phase first (loop.py); nothing in a print uses this file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from thermal.records import SampleBlock
from thermal.sensing.features import FeatureParameters
from thermal.sensing.laws import Law


@dataclass(frozen=True, slots=True)
class PaperParameters:
    """`alpha` is not given in the source; 0.5 makes its 20 ms out of sums of 8.5 ms."""

    law: Law
    front: FeatureParameters
    samples: int = 1024
    alpha: float = 0.5


@dataclass(slots=True)
class PaperState:
    """Running sum and filtered error."""

    total: float = 0.0
    count: int = 0
    error: float = math.nan


def paper_step(
    parameters: PaperParameters, state: PaperState, block: SampleBlock
) -> tuple[float, float] | None:
    """(time_s, temp_c) when a sum is complete, else None; temp_c is NaN where the law has no answer."""
    state.total += block.mean_raw * block.count
    state.count += block.count
    if state.count < parameters.samples:
        return None
    front = parameters.front
    error = (state.total / state.count - front.adc_zero_raw) * front.units_per_lsb
    state.total, state.count = 0.0, 0
    old = error if math.isnan(state.error) else state.error
    state.error = old * (1.0 - parameters.alpha) + error * parameters.alpha
    if not block.phase_ticks:
        return None
    end_s = block.time_s + block.duration_s
    return end_s - 0.5 * parameters.samples * block.duration_s / block.count, parameters.law.invert(
        state.error, block.phase_ticks
    )[0]
