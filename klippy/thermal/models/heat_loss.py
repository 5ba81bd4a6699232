"""Static heat balance of the nozzle: the watts that hold a temperature without extrusion.

    P(T) = g (T - Ta) + sigma eA ((T+273)^4 - (Ta+273)^4)

g is nozzle to ambient plus the series of nozzle to second mass and second mass to ambient (7.16 +
41.1*16.0/(41.1+16.0) = 18.7 mW/K). It gives 3.9 and 4.7 W at 212 and 250 degC, the static losses of source
000.
"""

from __future__ import annotations

from dataclasses import dataclass

import chelper

STEFAN_BOLTZMANN = 5.670374e-8  # W/m^2K^4
ZERO_CELSIUS_K = 273.15


@dataclass(frozen=True, slots=True)
class LossLaw:
    """Parameters of the static balance."""

    conductance_w_k: float = 0.0187
    radiation_m2: float = 1.0e-4  # emissivity times area
    ambient_c: float = 25.0


@dataclass(frozen=True, slots=True)
class HeatCapacity:
    """C(T) = at_25c (1 + slope (T - 25)): 0.9 g of AISI 430 at 460 J/kgK."""

    at_25c_j_k: float = 0.414
    slope_per_k: float = 4.5e-4

    def at(self, temp_c: float) -> float:
        return self.at_25c_j_k * (1.0 + self.slope_per_k * (temp_c - 25.0))


def loss_w(law: LossLaw, temp_c: float) -> float:
    """Heat that leaves a nozzle held at `temp_c`, never negative."""
    lib = chelper.get_ffi()[1]
    return float(lib.nozzle_loss_w(law.conductance_w_k, law.radiation_m2, law.ambient_c, temp_c))
