"""Geometry shared by the delta machines: the point hanging from three joints, and limits of heads homed at the top."""

from __future__ import annotations

import math
from collections.abc import Sequence

# Centre (x, y, z) and radius squared, mm and mm^2.
Sphere = tuple[Sequence[float], float]
# Where a carriage (arm) must move faster than this many times the head, moves slow down: to a half, and to a
# quarter beyond twice the ratio (documented for deltesian as slow_ratio).
SLOW_RATIO = 3.0


def _sub(a: Sequence[float], b: Sequence[float]) -> list[float]:
    return [p - q for p, q in zip(a, b, strict=True)]


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(p * q for p, q in zip(a, b, strict=True))


def _cross(a: Sequence[float], b: Sequence[float]) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def lower_meeting_point(spheres: Sequence[Sphere]) -> list[float]:
    """The lower of the two points in which three spheres meet (the head hangs below its joints).

    |p - c_i|^2 = r_i^2; the differences to the first sphere are two planes n_i.q = d_i (q = p - c_0), which meet in
    the line q = q0 + t*u with u = n1 x n2; |q|^2 = r_0^2 gives t.
    """
    (c0, r0), (c1, r1), (c2, r2) = spheres
    n1, n2 = _sub(c1, c0), _sub(c2, c0)
    d1, d2 = 0.5 * (_dot(n1, n1) + r0 - r1), 0.5 * (_dot(n2, n2) + r0 - r2)
    u = _cross(n1, n2)
    uu = _dot(u, u)
    if not uu:
        return list(c0)
    q0 = [(d1 * p + d2 * q) / uu for p, q in zip(_cross(n2, u), _cross(u, n1), strict=True)]
    t = math.sqrt(max(0.0, (r0 - _dot(q0, q0)) / uu))
    if u[2] > 0.0:
        t = -t
    return [c + q + t * k for c, q, k in zip(c0, q0, u, strict=True)]


def slow_reach(arm: float, ratio: float) -> float:
    """Horizontal reach of an arm at which its carriage moves `ratio` times as fast as the head."""
    return arm * ratio / math.sqrt(1.0 + ratio * ratio)
