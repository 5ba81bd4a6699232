"""What surrounds the roads already deposited; where they are and how warm they still are is in deposit.c."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Boundary of the part. h: 30 W/m2K still air with radiation, up to 90 with the fan (typical, settable)."""

    bed_c: float = 60.0
    chamber_c: float = 25.0
    still_w_m2k: float = 30.0
    fan_w_m2k: float = 60.0  # added at full fan
    bed_reach_mm: float = 3.0  # height over which the bed's influence falls to 1/e

    def around_c(self, z_mm: float) -> float:
        return self.chamber_c + (self.bed_c - self.chamber_c) * math.exp(-max(0.0, z_mm) / self.bed_reach_mm)
