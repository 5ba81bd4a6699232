"""Is the nozzle as cold as the room? The slope of its reading says so, whatever the reading is off by.

With the heater off it cools towards the room with a time constant tau: excess = -tau dT/dt. The heat of the sensing
pulses is known and taken off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

BIN_S = 0.09  # readings of so long are averaged
KEPT = 64
WINDOW_S = 20.0
READINGS_MIN = 4
PULSE_DOUBT = 0.15  # of the heat of the pulses
TAU_DOUBT = 0.3  # of the excess: the second mass cools at another rate
USUAL_C = 6.0  # a nozzle at rest is that much warmer than the room, 1 sigma, before the slope says more
BELOW_C = 3.0  # one that reads less than the room's temperature is nearly as cold
NEAR_C, NEAR_SIGMA_C = 2.5, 1.0  # one that reads so near to it is as cold, unless the slope says else ...
SLOPE_SIGMA, SLOPE_S = 2.0, 2.0  # ... by so much of its noise, for so long: a swing has slopes, too
STILL_C = 3.0  # readings that differ by more swing


@dataclass(slots=True)
class Rest:
    """Readings at the sensing phase while the heater is off, each a mean over BIN_S."""

    readings: list[tuple[float, float, float]] = field(default_factory=list)  # s, degC, J put in so far
    noise_c2: list[float] = field(default_factory=list)  # variance of each
    heat_j: float = 0.0
    sums: list[float] = field(default_factory=lambda: [0.0] * 4)  # of s, degC, J, degC^2 in the present bin
    count: int = 0
    bin_s: float = math.nan  # start of the bin

    def restart(self) -> None:
        self.readings.clear()
        self.noise_c2.clear()
        self.heat_j, self.count = 0.0, 0

    def note(self, time_s: float, temp_c: float, noise_c: float, heat_j: float) -> None:
        """A reading, and the heat of its pulse."""
        self.heat_j += heat_j
        if self.count and time_s - self.bin_s >= BIN_S:
            self._close()
        if not self.count:
            self.sums, self.bin_s = [0.0] * 4, time_s
        for i, value in enumerate((time_s, temp_c, self.heat_j, noise_c * noise_c)):
            self.sums[i] += value
        self.count += 1

    def _close(self) -> None:
        n, readings = self.count, self.readings
        readings.append((self.sums[0] / n, self.sums[1] / n, self.sums[2] / n))
        self.noise_c2.append(self.sums[3] / n**2)
        self.count = 0
        while readings[-1][0] - readings[0][0] > WINDOW_S or len(readings) > KEPT:
            readings.pop(0)
            self.noise_c2.pop(0)

    def has_any(self) -> bool:
        return bool(self.count or self.readings)

    def mean_c(self) -> float:
        """Of what there is."""
        if not self.readings:
            return self.sums[1] / self.count
        return math.fsum(c for _, c, _ in self.readings) / len(self.readings)

    def is_still(self) -> bool:
        """Do the readings agree?"""
        shown_c = [c for _, c, _ in self.readings]
        return max(shown_c) - min(shown_c) <= STILL_C

    def excess_c(self, tau_s: float, capacity_j_k: float, room_c: float) -> tuple[float, float]:
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
        noise_c = math.sqrt(max(math.fsum(self.noise_c2) / count, left / (count - 2)))
        noise_c = math.hypot(tau_s * noise_c / math.sqrt(spread), tau_s * PULSE_DOUBT * heated)
        is_short = readings[-1][0] - readings[0][0] < SLOPE_S
        if abs(mean_c - room_c) <= NEAR_C and (is_short or excess_c < SLOPE_SIGMA * noise_c):
            return 0.0, NEAR_SIGMA_C
        # Starts are usually cold: what the slope does not show for sure is noise.
        excess_c = max(0.0, excess_c) * USUAL_C**2 / (USUAL_C**2 + noise_c**2)
        max_c = max(0.0, mean_c - room_c) + BELOW_C
        sigma_c = math.hypot(min(noise_c, USUAL_C), TAU_DOUBT * excess_c)
        return min(excess_c, max_c), min(sigma_c, max_c)
