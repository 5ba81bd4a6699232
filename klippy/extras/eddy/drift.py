"""The frequency at the temperature of the calibration, from that at another.

At some heights the frequency was measured over the temperature; a parabola each. A frequency f at a temperature T lies
between those of two heights: what these two change from T to the calibration's temperature, it changes in proportion.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence

from configfile import ConfigWrapper

from ..probing.surface_fit import solve

REFERENCE_C = 40.0  # of the polynomials: their numbers stay small
MIN_TEMPERATURES = 3
PIVOT_MIN = 1e-9
Parabola = tuple[float, float, float]  # of (T - REFERENCE_C): Hz, Hz/K, Hz/K^2


def value(parabola: Parabola, temp_c: float) -> float:
    x = temp_c - REFERENCE_C
    return parabola[0] + x * (parabola[1] + x * parabola[2])


def fit(samples: Sequence[tuple[float, float]]) -> Parabola:
    """Through (temperature, frequency)."""
    powers = [[(t - REFERENCE_C) ** n for n in range(3)] for t, _ in samples]
    squares = [[sum(row[i] * row[k] for row in powers) for k in range(3)] for i in range(3)]
    base = samples[0][1]  # small numbers lose no digits
    right = [
        sum(row[i] * (hz - base) for row, (_, hz) in zip(powers, samples, strict=True)) for i in range(3)
    ]
    a, b, c = solve(squares, right, PIVOT_MIN)
    return a + base, b, c


class Drift:
    """The correction of one probe."""

    def __init__(self, parabolas: Sequence[Parabola], calibration_c: float) -> None:
        """Raises ValueError if there are too few, or they are out of order."""
        self.calibration_c = calibration_c
        self._parabolas = sorted(parabolas, key=lambda p: value(p, calibration_c))
        if len(self._parabolas) < 2:
            raise ValueError("it needs the parabolas of two heights at least")

    @staticmethod
    def read(config: ConfigWrapper) -> Drift | None:
        rows = config.getlists("drift_calibration", None, seps=(",", "\n"), parser=float, count=3)
        calibration_c = config.getfloat("calibration_temp", None)
        config.getfloat("drift_calibration_min_temp", None)  # noted for people
        if rows is None:
            return None
        if calibration_c is None:
            raise config.error(
                f"Option 'drift_calibration' in section '{config.get_name()}' ({config.where('drift_calibration')})"
                " needs option 'calibration_temp': run PROBE_EDDY_CURRENT_CALIBRATE again, with a [temperature_probe]."
            )
        try:
            return Drift([(row[0], row[1], row[2]) for row in rows], calibration_c)
        except ValueError as e:
            raise config.error(
                f"Option 'drift_calibration' in section '{config.get_name()}'"
                f" ({config.where('drift_calibration')}): {e}"
            ) from None

    def text(self) -> str:
        """For the config."""
        return "\n" + "\n".join(f"{a:.3f}, {b:.6f}, {c:.8f}" for a, b, c in self._parabolas)

    def _shift(self, hz: float, from_c: float, to_c: float) -> float:
        places = [value(p, from_c) for p in self._parabolas]
        i = min(max(bisect.bisect_right(places, hz), 1), len(places) - 1)
        share = (hz - places[i - 1]) / (places[i] - places[i - 1])
        low, high = (value(self._parabolas[k], to_c) - places[k] for k in (i - 1, i))
        return hz + low + min(max(share, -1.0), 2.0) * (high - low)

    def corrected(self, hz: float, temp_c: float) -> float:
        """What it would be at the calibration's temperature."""
        return self._shift(hz, temp_c, self.calibration_c)

    def expected(self, hz: float, temp_c: float) -> float:
        """The other way: of the calibration, at a temperature now."""
        return self._shift(hz, self.calibration_c, temp_c)
