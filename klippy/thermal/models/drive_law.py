"""Drive law: heat in the nozzle as a function of bridge phase and supply voltage, and its exact inverse.

P = P_full sin(phi/2)^n (Vdc/V0)^n,    phi = pi phase/phase_max        (fit to Oskolkov 2021)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import chelper
from thermal.records import PHASE_MAX_TICKS


@dataclass(frozen=True, slots=True)
class DriveLaw:
    """Heat in the nozzle as a function of phase and supply voltage."""

    power_full_w: float = 81.3  # at 180 degrees and vdc_reference_v
    exponent: float = 1.5
    vdc_v: float = 24.0
    vdc_reference_v: float = 24.0
    phase_max_ticks: int = PHASE_MAX_TICKS

    @property
    def power_max_w(self) -> float:
        """Heat at full phase with the present supply."""
        return self.power_full_w * (self.vdc_v / self.vdc_reference_v) ** self.exponent

    def power_w(self, phase_ticks: float) -> float:
        """Heat at this phase."""
        lib = chelper.get_ffi()[1]
        return float(lib.drive_power_w(self.power_max_w, self.exponent, self.phase_max_ticks, phase_ticks))

    def phase_ticks(self, power_w: float) -> float:
        """Phase (not yet whole ticks) that gives this heat; limited to 0..full."""
        if power_w <= 0.0:
            return 0.0
        amplitude = min(1.0, power_w / self.power_max_w) ** (1.0 / self.exponent)
        return 2.0 * math.asin(amplitude) / math.pi * self.phase_max_ticks
