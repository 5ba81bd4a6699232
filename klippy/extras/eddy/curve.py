"""Height over frequency, measured by PROBE_EDDY_CURRENT_CALIBRATE: the nearer the bed, the higher the frequency."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Sequence

from configfile import ConfigWrapper

MIN_POINTS = 5
DIGITS_MM, DIGITS_HZ = 6, 3


class Curve:
    """Straight between the points; beyond the first and the last on as there."""

    def __init__(self, points: Sequence[tuple[float, float]]) -> None:
        """`points`: (height mm, frequency Hz). Raises ValueError if they do not fall with the height."""
        ordered = sorted(points)
        if len(ordered) < MIN_POINTS:
            raise ValueError(f"it has {len(ordered)} points and needs {MIN_POINTS}")
        if any(b[1] >= a[1] for a, b in itertools.pairwise(ordered)):
            raise ValueError("the frequency does not fall with the height everywhere")
        self._heights = [height for height, _ in reversed(ordered)]
        self._frequencies = [hz for _, hz in reversed(ordered)]  # rising

    @staticmethod
    def read(config: ConfigWrapper, option: str = "calibrate") -> Curve | None:
        """The curve of an option; None: not calibrated."""
        pairs = config.getlists(option, None, seps=(":", ","), parser=float, count=2)
        if pairs is None:
            return None
        try:
            return Curve(pairs)
        except ValueError as e:
            raise config.error(
                f"Option '{option}' in section '{config.get_name()}' ({config.where(option)}): {e}. Run"
                " PROBE_EDDY_CURRENT_CALIBRATE again."
            ) from None

    def text(self) -> str:
        """For the config."""
        pairs = sorted(zip(self._heights, self._frequencies, strict=True))
        return ",".join(f"{height:.{DIGITS_MM}f}:{hz:.{DIGITS_HZ}f}" for height, hz in pairs)

    @staticmethod
    def _between(x: float, xs: Sequence[float], ys: Sequence[float]) -> float:
        """xs rise."""
        i = min(max(bisect.bisect_right(xs, x), 1), len(xs) - 1)
        share = (x - xs[i - 1]) / (xs[i] - xs[i - 1])
        return ys[i - 1] + share * (ys[i] - ys[i - 1])

    def height_mm(self, hz: float) -> float:
        return self._between(hz, self._frequencies, self._heights)

    def hz(self, height_mm: float) -> float:
        return self._between(height_mm, self._heights[::-1], self._frequencies[::-1])

    def slope_hz_mm(self, height_mm: float, step_mm: float = 0.05) -> float:
        """How fast the frequency rises towards the bed."""
        return (self.hz(height_mm - step_mm) - self.hz(height_mm + step_mm)) / (2.0 * step_mm)

    @property
    def range_mm(self) -> tuple[float, float]:
        return self._heights[-1], self._heights[0]
