"""Where the nozzle touched: a line with one corner through the force over the height.

    force │*
          │  *                      F(z) = F0 + s (z0 - z) below z0, F0 above; z0 by the smallest sum of squares
          │    * * * * * * *
          └────┼─────────────── z
               z0

For a given z0 the best F0 and s are those of a linear regression on max(0, z0 - z), and what is left is a smooth
function of z0 between neighbouring heights: the best interval, then a golden section within it.
"""

from __future__ import annotations

from collections.abc import Sequence

MIN_SIDE = 3  # samples above the contact, and below it
TRIES = 64
GOLDEN = 0.6180339887498949
Point = tuple[float, float]  # height (mm), force


def _regression(points: Sequence[Point], corner: float) -> tuple[float, float, float]:
    """(sum of squares left, F0, slope) with the corner at a height."""
    count = len(points)
    depths = [max(0.0, corner - z) for z, _ in points]
    mean_d, mean_f = sum(depths) / count, sum(force for _, force in points) / count
    var = sum((d - mean_d) ** 2 for d in depths)
    if var <= 0.0:
        return sum((force - mean_f) ** 2 for _, force in points), mean_f, 0.0
    slope = sum((d - mean_d) * (force - mean_f) for d, (_, force) in zip(depths, points, strict=True)) / var
    base = mean_f - slope * mean_d
    left = sum((force - base - slope * d) ** 2 for d, (_, force) in zip(depths, points, strict=True))
    return left, base, slope


def find_contact(points: Sequence[Point]) -> float | None:
    """Height of the first contact, mm; None if the points do not show one."""
    ordered = sorted(points)
    if len(ordered) < 2 * MIN_SIDE:
        return None
    heights = [z for z, _ in ordered]
    first, last = MIN_SIDE - 1, len(ordered) - MIN_SIDE
    best = min(range(first, last), key=lambda i: _regression(ordered, heights[i])[0])
    low, high = heights[max(first, best - 1)], heights[min(last, best + 1)]
    for _ in range(TRIES):
        a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
        if _regression(ordered, a)[0] < _regression(ordered, b)[0]:
            high = b
        else:
            low = a
    corner = 0.5 * (low + high)
    return corner if _regression(ordered, corner)[2] > 0.0 else None
