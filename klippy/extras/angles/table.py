"""The error of a sensor over a turn: a magnet off the axis, and the sensor's own. Angles are in 65536ths of a turn."""

from __future__ import annotations

import bisect
from collections.abc import Sequence

TURN = 65536
POINTS = 64


def nearest(difference: float) -> float:
    """The same angle between minus and plus half a turn."""
    return (difference + TURN / 2.0) % TURN - TURN / 2.0


def make_table(true: Sequence[float], seen: Sequence[float]) -> list[float]:
    """Corrections at POINTS angles, from true angles and what the sensor said."""
    shift = seen[0] - true[0]
    pairs = sorted((s % TURN, nearest(t + shift - s)) for t, s in zip(true, seen, strict=True))
    mean = sum(error for _, error in pairs) / len(pairs)
    angles = [pairs[-1][0] - TURN, *(a for a, _ in pairs), pairs[0][0] + TURN]
    errors = [pairs[-1][1], *(e for _, e in pairs), pairs[0][1]]
    table = []
    for point in range(POINTS):
        at = point * TURN / POINTS
        i = min(max(bisect.bisect_right(angles, at), 1), len(angles) - 1)
        share = (at - angles[i - 1]) / (angles[i] - angles[i - 1])
        table.append(round(errors[i - 1] + share * (errors[i] - errors[i - 1]) - mean, 1))
    return table


def corrected(angle: float, table: Sequence[float]) -> float:
    """Straight between the points."""
    place = angle / TURN * len(table)
    index = int(place)
    low, high = table[index % len(table)], table[(index + 1) % len(table)]
    return angle + low + (place - index) * (high - low)
