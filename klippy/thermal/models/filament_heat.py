"""How warm the core of the filament is when it leaves the hot zone: a cylinder after a step of its wall's temperature.

1 - theta = sum 2/(z J1(z)) exp(-z^2 Fo) over the zeros z of the Bessel function J0 (Carslaw 1959); Fo = chi t / r^2.
"""

from __future__ import annotations

import math

FOURIER_MIN = 0.02  # below it the core has seen less than 1e-5 of the wall's step
# z and 2/(z J1(z)); a ninth term is below 1e-6.
CORE_TERMS = (
    (2.404825557695773, 1.601974696928), (5.520078110286311, -1.064799258422), (8.653727912911013, 0.851399192337),
    (11.79153443901428, -0.729645239818), (14.93091770848779, 0.648523614291), (18.07106396791092, -0.589542829305),
    (21.21163662987926, 0.544180195837), (24.35247153074930, -0.507893630797),
)  # fmt: skip


def core_fraction(fourier: float) -> float:
    """Share of the wall's step that has reached the axis of a cylinder, 0..1."""
    if fourier < FOURIER_MIN:
        return 0.0
    return 1.0 - sum(a * math.exp(-z * z * fourier) for z, a in CORE_TERMS)
