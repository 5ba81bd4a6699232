"""Weld between a fresh road and what lies under it: the temperature of the interface.

Two half spaces in contact take at once the temperature weighted by their effusivities e = sqrt(k rho c). Equal
media therefore meet at the mean; HydraRaptor 2007 has that, but its rule for unlike media (heat capacity) is wrong.
"""

from __future__ import annotations

import math


def effusivity(conductivity_w_mk: float, density_kg_m3: float, heat_j_kgk: float) -> float:
    """W s^0.5 / (m2 K)."""
    return math.sqrt(conductivity_w_mk * density_kg_m3 * heat_j_kgk)


def interface_c(melt_c: float, substrate_c: float, melt_e: float = 1.0, substrate_e: float = 1.0) -> float:
    """Temperature of the contact at the moment of touching."""
    return (melt_e * melt_c + substrate_e * substrate_c) / (melt_e + substrate_e)


def melt_for_interface(
    wanted_c: float, substrate_c: float, melt_e: float = 1.0, substrate_e: float = 1.0
) -> float:
    """Melt temperature that brings the interface to `wanted_c`."""
    return wanted_c + (wanted_c - substrate_c) * substrate_e / melt_e


def held_c(usual_c: float, band_c: tuple[float, float], lowest_c: float) -> float:
    """The interface to hold on a path: as near to the usual one as the material's window reaches on its hot and on its
    cold end, or, where the window is too narrow for both, the middle. Never below `lowest_c`.

    `band_c`: what the coolest melt makes of the hottest substrate and the hottest melt of the coldest.
    """
    low_c, high_c = band_c
    reached_c = min(high_c, max(low_c, usual_c)) if low_c <= high_c else 0.5 * (low_c + high_c)
    return max(lowest_c, reached_c)


def bonds(interface_temp_c: float, bonding_c: float, margin_c: float = 0.0) -> bool:
    """Is the interface hot enough for chains to cross it?"""
    return interface_temp_c >= bonding_c + margin_c
