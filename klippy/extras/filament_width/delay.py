"""Diameters on their way from the sensor to the melt. Lengths are positions of the extruder, mm.

measured ──►  [ .. | .. | .. | .. ]  ──► melting
              ◄──── delay_mm ────►
"""

from __future__ import annotations

from collections import deque

CUT_MM = 5.0  # filament may be drawn back this far before the queue is of other filament


class WidthQueue:
    """One diameter for each `interval_mm` of filament."""

    def __init__(self, delay_mm: float, interval_mm: float) -> None:
        self._delay_mm, self._interval_mm = delay_mm, interval_mm
        self._waiting: deque[tuple[float, float]] = deque()  # (position at which it melts, diameter)
        self._next_mm: float | None = None
        self._last_mm = 0.0
        self._sum, self._count = 0.0, 0

    def clear(self) -> None:
        self._waiting.clear()
        self._next_mm = None
        self._sum, self._count = 0.0, 0

    def measure(self, position_mm: float, diameter_mm: float) -> float | None:
        """A reading at the sensor. Returns the mean diameter of the interval, if one has just ended."""
        if self._next_mm is not None and position_mm < self._next_mm - self._interval_mm - CUT_MM:
            self.clear()
        if self._next_mm is None:
            self._next_mm = position_mm + self._interval_mm
        elif position_mm <= self._last_mm:
            return None  # filament that stands would count for more than its length
        self._last_mm = position_mm
        self._sum, self._count = self._sum + diameter_mm, self._count + 1
        if position_mm < self._next_mm:
            return None
        mean = self._sum / self._count
        self._waiting.append((position_mm + self._delay_mm, mean))
        self._next_mm = position_mm + self._interval_mm
        self._sum, self._count = 0.0, 0
        return mean

    def melting(self, position_mm: float) -> float | None:
        """The newest diameter that has reached the melt; None if none has since it was last asked for."""
        found = None
        while self._waiting and self._waiting[0][0] <= position_mm:
            found = self._waiting.popleft()[1]
        return found
