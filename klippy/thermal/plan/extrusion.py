"""Extrusion options of HydraRaptor 2007: die swell, and ooze after the drive has stopped or the nozzle has been cold.

Die swell: the filament leaves the hole wider than the hole, d = dh + k v_o, and the volume is conserved:
v_o (dh + k v_o)^2 = v_i d_i^2. Lengths in mm, speeds in mm/s, k in s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DieSwell:
    """hole_mm: diameter at vanishing speed (wider than drilled); gain_s: widening per speed."""

    hole_mm: float
    gain_s: float


def exit_speed(swell: DieSwell, feed_mm_s: float, filament_mm: float) -> float:
    """v_o of the cubic. The left side rises with v_o, so bisection between 0 and the unswollen speed is safe."""
    volume = feed_mm_s * filament_mm**2
    low, high = 0.0, volume / swell.hole_mm**2
    for _ in range(60):
        middle = 0.5 * (low + high)
        if middle * (swell.hole_mm + swell.gain_s * middle) ** 2 < volume:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def exit_diameter(swell: DieSwell, feed_mm_s: float, filament_mm: float) -> float:
    return swell.hole_mm + swell.gain_s * exit_speed(swell, feed_mm_s, filament_mm)


CALIPERS_MM = 0.02  # two readings of 0.01


def fit_die_swell(feeds_mm_s: Sequence[float], widths_mm: Sequence[float], filament_mm: float) -> DieSwell:
    """Least squares of d = dh + k v_o through measured widths; v_o follows from each width by volume.

    Widths that fall with speed by no more than calipers err mean no swell; by more they are no strands of this model.
    """
    if len(feeds_mm_s) != len(widths_mm) or len(set(feeds_mm_s)) < 2:
        raise ValueError("Die swell needs a width for each feed speed, at two different speeds at least.")
    if min(widths_mm) <= 0.0 or min(feeds_mm_s) <= 0.0:
        raise ValueError("Die swell needs widths and feed speeds above zero.")
    if max(widths_mm) >= filament_mm:
        raise ValueError(
            f"A strand {max(widths_mm):g} mm wide cannot come from filament of {filament_mm:g} mm; widths are in mm."
        )
    speeds = [v * filament_mm**2 / d**2 for v, d in zip(feeds_mm_s, widths_mm, strict=True)]
    mean_v = sum(speeds) / len(speeds)
    mean_d = sum(widths_mm) / len(widths_mm)
    spread = sum((v - mean_v) ** 2 for v in speeds)
    if spread <= 0.0:
        raise ValueError("All widths give the same exit speed; measure at speeds further apart.")
    gain = sum((v - mean_v) * (d - mean_d) for v, d in zip(speeds, widths_mm, strict=True)) / spread
    if gain < 0.0:
        if -gain * (max(speeds) - min(speeds)) > CALIPERS_MM:
            raise ValueError(
                "The strands get thinner as the speed rises, and a swelling melt gets wider."
                " Are speeds and widths in the same order?"
            )
        gain = 0.0
    hole = mean_d - gain * mean_v
    if hole <= 0.0:
        raise ValueError("The fit gives a hole without width; the measured widths do not follow the model.")
    return DieSwell(hole, gain)


@dataclass(frozen=True, slots=True)
class Overrun:
    """Filament still leaving after a stop: total length and time constant of the decay; and, once more, what comes
    when the nozzle has been cold meanwhile and is warm again."""

    total_mm: float
    tau_s: float
    reheat_mm: float = 0.0


def oozed_mm(overrun: Overrun, idle_s: float, reheated: bool = False) -> float:
    """Length that has left `idle_s` after the stop: what must be fed before the next road starts."""
    left_mm = overrun.total_mm * -math.expm1(-max(0.0, idle_s) / overrun.tau_s)
    return left_mm + overrun.reheat_mm * reheated
