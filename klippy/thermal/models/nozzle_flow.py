"""Pressure in a nozzle, the force that feeds the filament, and when it fails: Tlegenov 2018, eqs 1 to 20, put right.

The melt is a power-law fluid, shear rate = (stress/K)^m, m = 1/n. In a pipe of radius R the stress at the wall for a
flow Q is K (Q (m + 3)/(pi R^3))^(1/m), and the pressure falls by 2 stress/R a length. That over the three zones gives

    barrel    dp1 = 2 L1/R1 s(R1)                                        s(R) = K (Q (m + 3)/(pi R^3))^(1/m)
    cone      dp2 = 2 m/(3 tan(a/2)) K (Q (m + 3)/pi)^(1/m) (R2^(-3/m) - R1^(-3/m))
    orifice   dp3 = 2 L3/R2 s(R2)

and at a temperature T (kelvin) all of it times exp(beta (1/T - 1/T0)), the Arrhenius law (eqs 7, 8). The drive pushes
with F = dp * area of the filament (eq. 9) until it slips, or the filament buckles at pi^2 E I/L^2 (Euler, eq. 2).

What the source has otherwise:

  eq. 1   F = 2 T/R: right with the diameter of the wheel in place of R; torque over radius is half of that
  eq. 4   the sum of the two terms of the cone: without a cone (R1 = R2) that is not 0. Their difference is right; and
          the speed is that of the barrel, so R1^2 v, not R2^2 v
  eq. 5   R2^(q+1): the mean speed of the barrel is in it, so the exponent is q + 3
  eq. 10  W = F_feed - F_bp falls as a clog grows, and the amplitude measured rises. The vibration has to be driven by
          the back pressure
  eq. 17  with the source's own table (aluminium, 30 x 13 x 16 mm and 100 x 22 x 6 mm) gives 41 kHz and 1.4 kHz, not
          203.6 and 16.5 Hz: the mount is no beam on two pins. Its frequency has to be measured
  eq. 20  amplitudes are off by 10^4, and the inputs damping, excitation, place of the load are missing

So nothing of the beam's amplitude is computed here; the measured ones are power laws of the diameter (AMPLITUDES).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

KELVIN = 273.15


@dataclass(frozen=True, slots=True)
class Melt:
    """K in Pa s^n, n, and the Arrhenius constant (K) from a reference temperature (degC)."""

    consistency: float
    flow_index: float
    arrhenius_k: float
    reference_c: float


@dataclass(frozen=True, slots=True)
class NozzleShape:
    """mm, degrees: barrel, cone of the full angle, orifice."""

    barrel_mm: float
    barrel_length_mm: float
    cone_deg: float
    orifice_mm: float
    orifice_length_mm: float


@dataclass(frozen=True, slots=True)
class Filament:
    """Diameter (mm), Young's modulus (Pa), length between drive and melt that nothing guides (mm)."""

    diameter_mm: float
    modulus_pa: float
    free_length_mm: float

    @property
    def area_m2(self) -> float:
        return math.pi / 4.0 * (self.diameter_mm * 1e-3) ** 2


def pressure_zones_pa(
    shape: NozzleShape, melt: Melt, flow_mm3_s: float, temp_c: float
) -> tuple[float, float, float]:
    """Pressure drops of barrel, cone and orifice."""
    m = 1.0 / melt.flow_index
    r1, r2 = 0.5e-3 * shape.barrel_mm, 0.5e-3 * shape.orifice_mm
    shear = (flow_mm3_s * 1e-9 * (m + 3.0) / math.pi) ** (1.0 / m) * melt.consistency
    thin = math.exp(melt.arrhenius_k * (1.0 / (temp_c + KELVIN) - 1.0 / (melt.reference_c + KELVIN)))
    cone = 2.0 * m / (3.0 * math.tan(math.radians(0.5 * shape.cone_deg)))
    return (
        thin * shear * 2e-3 * shape.barrel_length_mm * r1 ** (-1.0 - 3.0 / m),
        thin * shear * cone * (r2 ** (-3.0 / m) - r1 ** (-3.0 / m)),
        thin * shear * 2e-3 * shape.orifice_length_mm * r2 ** (-1.0 - 3.0 / m),
    )


def back_force_n(
    shape: NozzleShape, melt: Melt, filament: Filament, flow_mm3_s: float, temp_c: float
) -> float:
    """With which the melt resists the filament (eq. 9)."""
    return sum(pressure_zones_pa(shape, melt, flow_mm3_s, temp_c)) * filament.area_m2


def feed_force_n(torque_nm: float, wheel_diameter_mm: float) -> float:
    """That a drive can give: torque over radius."""
    return 2.0 * torque_nm / (wheel_diameter_mm * 1e-3)


def buckling_force_n(filament: Filament) -> float:
    """Euler's limit of a column on two pins."""
    inertia = math.pi / 64.0 * (filament.diameter_mm * 1e-3) ** 4
    return math.pi**2 * filament.modulus_pa * inertia / (filament.free_length_mm * 1e-3) ** 2


def greatest_flow_mm3_s(
    shape: NozzleShape, melt: Melt, filament: Filament, force_n: float, temp_c: float
) -> float:
    """Flow at which the back pressure takes the whole force: force grows with the flow to the power n."""
    return float((force_n / back_force_n(shape, melt, filament, 1.0, temp_c)) ** (1.0 / melt.flow_index))


def beam_hz(length_mm: float, width_mm: float, height_mm: float, modulus_pa: float, density: float) -> float:
    """First natural frequency of a beam on two pins that bends along its height (eq. 17)."""
    length, width, height = (1e-3 * x for x in (length_mm, width_mm, height_mm))
    inertia = width * height**3 / 12.0
    return 0.5 * math.pi / length**2 * math.sqrt(modulus_pa * inertia / (density * width * height))


@dataclass(frozen=True, slots=True)
class AmplitudeLaw:
    """Measured acceleration (m/s^2) at the mount's frequency: base (new diameter/diameter)^exponent."""

    base_m_s2: float
    exponent: float
    diameter_mm: float
    frequency_hz: float

    def amplitude_m_s2(self, diameter_mm: float) -> float:
        return float(self.base_m_s2 * (self.diameter_mm / diameter_mm) ** self.exponent)

    def diameter_of(self, amplitude_m_s2: float) -> float:
        """mm; the inverse."""
        return float(self.diameter_mm * (self.base_m_s2 / amplitude_m_s2) ** (1.0 / self.exponent))


# Fitted to Tlegenov 2018, tables 2 and 3 (PLA at one flow and temperature): 1.9 % and 2.5 % root mean square.
AMPLITUDES = {
    "direct": AmplitudeLaw(0.599, 3.86, 0.40, 200.0),
    "bowden": AmplitudeLaw(0.228, 4.91, 0.35, 16.0),
}
