"""Weld between a fresh road and what lies under it: the temperature of the interface is the mean of both.

That holds for two half spaces of equal media (HydraRaptor 2007). Unlike media are weighted with sqrt(k rho c).
"""

from __future__ import annotations


def held_c(usual_c: float, band_c: tuple[float, float], lowest_c: float) -> float:
    """The interface to hold on a path: as near to the usual one as the material's window reaches on its hot and on its
    cold end, or, where the window is too narrow for both, the middle. Never below `lowest_c`.

    `band_c`: what the coolest melt makes of the hottest substrate and the hottest melt of the coldest.
    """
    low_c, high_c = band_c
    reached_c = min(high_c, max(low_c, usual_c)) if low_c <= high_c else 0.5 * (low_c + high_c)
    return max(lowest_c, reached_c)
