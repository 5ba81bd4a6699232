"""Parameters that make residuals small: Levenberg and Marquardt's method with numeric slopes. No printer here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from .surface_fit import solve

Residuals = Callable[[Mapping[str, float]], Sequence[float]]
ROUNDS_MAX = 200
# Steps of the slopes; parameters are mm and degrees, of which a thousandth matters.
SLOPE_STEP = 1e-4
# A round that improves the sum of squares by less than this share is the last.
IMPROVEMENT_MIN = 1e-9
DAMPING_MAX = 1e12


def _cost(residuals: Sequence[float]) -> float:
    return sum(r * r for r in residuals)


def fit(start: Mapping[str, float], free: Sequence[str], residuals: Residuals) -> dict[str, float]:
    """`start` with the parameters `free` changed so that the sum of squared residuals is as small as it gets.

    The damping keeps what the residuals do not determine near the start.
    """
    found = dict(start)
    now = residuals(found)
    damping = 1e-3
    for _ in range(ROUNDS_MAX):
        slopes = [
            [
                (a - b) / SLOPE_STEP
                for a, b in zip(residuals({**found, n: found[n] + SLOPE_STEP}), now, strict=True)
            ]
            for n in free
        ]
        squares = [[sum(a * b for a, b in zip(p, q, strict=True)) for q in slopes] for p in slopes]
        towards = [-sum(s * r for s, r in zip(slope, now, strict=True)) for slope in slopes]
        while damping < DAMPING_MAX:
            damped = [[v + damping * (i == k) for k, v in enumerate(row)] for i, row in enumerate(squares)]
            change = solve(damped, towards, 0.0)
            tried = {**found, **{n: found[n] + c for n, c in zip(free, change, strict=True)}}
            then = residuals(tried)
            if _cost(then) < _cost(now):
                break
            damping *= 10.0
        else:
            return found
        gain = _cost(now) - _cost(then)
        found, now, damping = tried, then, damping * 0.1
        if gain <= IMPROVEMENT_MIN * _cost(now):
            return found
    return found
