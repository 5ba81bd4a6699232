"""Is the nozzle as cold as the room? The slope of its reading says so, whatever the reading is off by.

With the heater off it cools towards the room with a time constant tau: excess = -tau dT/dt. The heat of the sensing
pulses is known and taken off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

APART_S = 0.09  # between two readings that are kept
KEPT = 64
WINDOW_S = 20.0
READINGS_MIN = 4
PULSE_DOUBT = 0.15  # of the heat of the pulses
TAU_DOUBT = 0.3  # of the excess: the second mass cools at another rate
USUAL_C = 6.0  # a nozzle at rest is that much warmer than the room, 1 sigma, before the slope says more
BELOW_C = 3.0  # one that reads less than the room's temperature is nearly as cold


@dataclass(slots=True)
class Rest:
    """Readings (s, degC, J put in so far) at the sensing phase while the heater is off."""

    readings: list[tuple[float, float, float]] = field(default_factory=list)
    heat_j: float = 0.0

    def restart(self) -> None:
        self.readings.clear()
        self.heat_j = 0.0

    def note(self, time_s: float, temp_c: float, heat_j: float) -> None:
        """A reading, and the heat of its pulse."""
        self.heat_j += heat_j
        readings = self.readings
        if readings and time_s - readings[-1][0] < APART_S:
            return
        readings.append((time_s, temp_c, self.heat_j))
        while time_s - readings[0][0] > WINDOW_S or len(readings) > KEPT:
            readings.pop(0)

    def mean_c(self) -> float:
        return math.fsum(c for _, c, _ in self.readings) / len(self.readings)

    def excess_c(
        self, tau_s: float, capacity_j_k: float, noise_c: float, room_c: float
    ) -> tuple[float, float]:
        """(Nozzle above the room, its standard deviation); infinite with too few readings."""
        readings = self.readings
        count = len(readings)
        if count < READINGS_MIN:
            return 0.0, math.inf
        mean_s, mean_c = math.fsum(t for t, _, _ in readings) / count, self.mean_c()
        spread = math.fsum((t - mean_s) ** 2 for t, _, _ in readings)
        slope = math.fsum((t - mean_s) * (c - mean_c) for t, c, _ in readings) / spread
        heated = (readings[-1][2] - readings[0][2]) / (readings[-1][0] - readings[0][0]) / capacity_j_k
        excess_c = tau_s * (heated - slope)
        left = math.fsum((c - mean_c - slope * (t - mean_s)) ** 2 for t, c, _ in readings)
        noise_c = max(noise_c, math.sqrt(left / (count - 2)))
        noise_c = math.hypot(tau_s * noise_c / math.sqrt(spread), tau_s * PULSE_DOUBT * heated)
        # Starts are usually cold: what the slope does not show for sure is noise.
        excess_c = max(0.0, excess_c) * USUAL_C**2 / (USUAL_C**2 + noise_c**2)
        max_c = max(0.0, mean_c - room_c) + BELOW_C
        sigma_c = math.hypot(min(noise_c, USUAL_C), TAU_DOUBT * excess_c)
        return min(excess_c, max_c), min(sigma_c, max_c)
