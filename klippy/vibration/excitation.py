"""The motion of a resonance test along one axis, as stretches of constant acceleration.

    pulses   + - - + a quarter of a period each: from rest to rest, forth and back; a = accel_per_hz * f, f rises
    sweep    + - - + a quarter of sweeping_period each, beside them: motors that stand hide what friction holds

The sweep runs on to the end of its period, so that the whole ends where it began, at rest.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

QUARTERS = (1.0, -1.0, -1.0, 1.0)
_TINY_S = 1e-9


@dataclass(frozen=True, slots=True)
class Excitation:
    """Hz, mm/s^2 per Hz, Hz/s; sweeping_period_s 0: pulses alone."""

    min_hz: float = 5.0
    max_hz: float = 133.33
    accel_per_hz: float = 60.0
    hz_per_s: float = 1.0
    sweeping_accel: float = 400.0
    sweeping_period_s: float = 1.2

    @property
    def sweep_mm(self) -> float:
        """Length of the sweep's way."""
        return self.sweeping_accel * self.sweeping_period_s**2 / 16.0

    def pulses(self) -> Iterator[tuple[float, float, float]]:
        """(s, mm/s^2, Hz) of each quarter."""
        hz = self.min_hz
        while hz <= self.max_hz + 1e-6:
            for sign in QUARTERS:
                yield 0.25 / hz, sign * self.accel_per_hz * hz, hz
            hz += self.hz_per_s / hz

    def stretches(self) -> Iterator[tuple[float, float, float]]:
        """(s, mm/s^2, Hz): pulses and sweep together."""
        quarter_s = 0.25 * self.sweeping_period_s
        if quarter_s <= 0.0:
            yield from self.pulses()
            return
        number, left_s = 0, quarter_s  # of the sweep's quarters; rest of this one
        hz = self.min_hz

        def sweep() -> float:
            return QUARTERS[number % 4] * self.sweeping_accel

        for duration, accel, hz in self.pulses():
            rest = duration
            while rest > _TINY_S:
                part = min(rest, left_s)
                yield part, accel + sweep(), hz
                rest, left_s = rest - part, left_s - part
                if left_s <= _TINY_S:
                    number, left_s = number + 1, quarter_s
        while number % 4 or left_s < quarter_s:
            yield left_s, sweep(), hz
            number, left_s = number + 1, quarter_s

    @property
    def duration_s(self) -> float:
        """About."""
        return (self.max_hz - self.min_hz) / self.hz_per_s + self.sweeping_period_s


def split_at_rest(duration: float, speed: float, accel: float) -> list[tuple[float, float]]:
    """(s, speed at its start) of the parts of a stretch in which the speed keeps its sign."""
    if speed * (speed + accel * duration) < -_TINY_S and accel:
        turn = -speed / accel
        return [(turn, speed), (duration - turn, 0.0)]
    return [(duration, speed)]


def extent_mm(excitation: Excitation) -> float:
    """How far from the middle the test goes: half the sweep, and the longest pulse."""
    pulse = 2.0 * excitation.accel_per_hz / 32.0 / excitation.min_hz
    return 0.5 * excitation.sweep_mm + pulse if math.isfinite(pulse) else 0.0
