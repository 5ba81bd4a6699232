"""One block to a temperature with its uncertainty, by a sensing law (laws.py); done in C (thermal/sensing/pipeline.c).

Each block is converted with its own phase; filtering raw error across a phase step would give spikes of hundreds of
degrees. What falls outside a law's range is invalid and never a number.

    sigma = |dT/derror| sqrt(noise^2 + residual^2)        of it |dT/derror| noise can be filtered away
"""

from __future__ import annotations

from dataclasses import dataclass

from .laws import Law

# 0.2 % power, the smallest of Table 1: smallest excitation the laws were fitted on.
SENSING_PHASE_TICKS = 2012

# Far beyond the range the signal is not that of a nozzle that is merely hot: an empty coil reads much higher.
EMPTY_MARGIN_C = 150.0


@dataclass(frozen=True, slots=True)
class EstimatorParameters:
    """A law and the range in which it is valid."""

    law: Law
    temp_low_c: float = (
        -20.0
    )  # Table 1 begins at 110, the text at 20 degC: some room for noise and a cold workshop
    temp_high_c: float = 760.0  # Table 1 ends at 750 degC
    phase_low_ticks: int = SENSING_PHASE_TICKS
    supply: float = 1.0  # bridge voltage over the one the law was taken at
