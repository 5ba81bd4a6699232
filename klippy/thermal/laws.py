"""Sensing laws: error units at a bridge phase to temperature and back, all inverted in closed form.

`ExpLaw` (default without a calibration), fitted to Table 1 of source 000 with p = (phase/45000)^2:

    error = a T exp(-b p) + c + d p          =>  T = (error - c - d p) / (a exp(-b p))

`Eq5Law`, eq 5 of source 000 with the coefficients of its Table 2, i = phase in ticks:

    error = A T + B i + AB T i + BB i^2 + ABB T i^2 + C
                                             =>  T = (error - C - B i - BB i^2) / (A + AB i + ABB i^2)

`TankLaw`, the phase psi of the coil current in an LCL tank (what INDUCTION_CALIBRATE fits). The tank's reactance is
linear in the coil's inductance, that in temperature; the steel saturates with the coil's field, which goes with
the drive s = sin(phi/2) and with cos(psi):

    error = g psi + c + d exp(-m p)          tan(psi) = [(T - t0) S(u) + delta] / w
    S(u)  = exp(-b u - q u^4)                u = (s cos(psi) V/V0)^2
                                             =>  T = t0 + (w tan(psi) - delta) / S(u)

psi comes straight from the error, so u is known when T is asked for: no iteration on that side. `delta` is the detuning
(in degC): what a drifting capacitor or crystal moves, and what a one-point re-zero corrects.

`supply` is the bridge's voltage over the one the law was taken at; the field, and with it the saturation, goes with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Protocol

from .records import PHASE_MAX_TICKS

NAN_PAIR = (math.nan, math.nan)
FORWARD_ROUNDS = 30  # fixed point of the tank law forwards: each shrinks the error by more than 4
PSI_MAX_RAD = 1.35  # 77 degrees: beyond, the tangent magnifies noise twenty times


class Law(Protocol):
    """A sensing law, monotone in temperature at each phase."""

    @property
    def residual_units(self) -> float:
        """Standard deviation of the fit, error units."""
        ...

    def error(self, temp_c: float, phase_ticks: float, supply: float = 1.0) -> float:
        """Forwards: error units at a temperature and phase."""
        ...

    def invert(self, error: float, phase_ticks: float, supply: float = 1.0) -> tuple[float, float]:
        """(temperature in degC, dT/derror in degC per unit); two NaNs where the law has no answer."""
        ...

    def rezeroed(self, temp_c: float, error: float, phase_ticks: float, supply: float = 1.0) -> Law:
        """This law with its one drifting number changed so that `error` at this phase reads `temp_c`."""
        ...


def _power(phase_ticks: float) -> float:
    ratio = phase_ticks / PHASE_MAX_TICKS
    return ratio * ratio


@dataclass(frozen=True, slots=True)
class ExpLaw:
    """error = a T exp(-b p) + c + d p. Coefficients: four-parameter fit of Table 1, s = 0.975 units."""

    a: float = 0.801361
    b: float = 1.058014
    c: float = 1.397019
    d: float = 5.139702
    residual_units: float = 0.975

    def _line(self, phase_ticks: float, supply: float) -> tuple[float, float]:
        p = _power(phase_ticks)
        return self.c + self.d * p, self.a * math.exp(-self.b * p * supply * supply)

    def error(self, temp_c: float, phase_ticks: float, supply: float = 1.0) -> float:
        offset, slope = self._line(phase_ticks, supply)
        return offset + slope * temp_c

    def invert(self, error: float, phase_ticks: float, supply: float = 1.0) -> tuple[float, float]:
        offset, slope = self._line(phase_ticks, supply)
        return (error - offset) / slope, 1.0 / slope

    def rezeroed(self, temp_c: float, error: float, phase_ticks: float, supply: float = 1.0) -> ExpLaw:
        return replace(self, c=self.c + error - self.error(temp_c, phase_ticks, supply))


@dataclass(frozen=True, slots=True)
class Eq5Law:
    """Eq 5 of source 000, coefficients of Table 2. Residual 4.5-4.8 units, hence 6 degC at low power at best."""

    a: float = 0.825
    b: float = 0.0001081
    ab: float = -7.085e-06
    bb: float = 4.951e-10
    abb: float = -1.207e-10
    c: float = 0.797
    residual_units: float = 4.65

    def _line(self, phase_ticks: float, supply: float) -> tuple[float, float]:
        i, field = phase_ticks, phase_ticks * supply
        return self.c + (self.b + self.bb * i) * i, self.a + (self.ab + self.abb * field) * field

    def error(self, temp_c: float, phase_ticks: float, supply: float = 1.0) -> float:
        offset, slope = self._line(phase_ticks, supply)
        return offset + slope * temp_c

    def invert(self, error: float, phase_ticks: float, supply: float = 1.0) -> tuple[float, float]:
        offset, slope = self._line(phase_ticks, supply)
        return ((error - offset) / slope, 1.0 / slope) if slope > 0.0 else NAN_PAIR

    def rezeroed(self, temp_c: float, error: float, phase_ticks: float, supply: float = 1.0) -> Eq5Law:
        return replace(self, c=self.c + error - self.error(temp_c, phase_ticks, supply))


@dataclass(frozen=True, slots=True)
class TankLaw:
    """The phasor law. Defaults: its fit to Table 1 of source 000 (28 points, s = 1.03 units); see docs/Induction.md."""

    g: float = 1228.15  # units per radian of psi
    t0: float = 413.799  # degC of resonance
    w: float = 1510.08  # degC: series resistance over what a degree moves the reactance
    delta: float = -4.92667  # degC of detuning
    b: float = 0.4952  # saturation
    q: float = 0.592254
    c: float = 14.0704  # offset, units
    d: float = 323.045
    m: float = 1.06507
    residual_units: float = 1.03

    def _offset(self, phase_ticks: float) -> float:
        return self.c + self.d * math.exp(-self.m * _power(phase_ticks))

    @staticmethod
    def _field(phase_ticks: float, supply: float) -> float:
        amplitude = math.sin(0.5 * math.pi * phase_ticks / PHASE_MAX_TICKS) * supply
        return amplitude * amplitude

    def _saturation(self, u: float) -> float:
        """-ln S."""
        return u * (self.b + self.q * u * u * u)

    def angle(self, error: float, phase_ticks: float) -> float:
        """psi in radians."""
        return (error - self._offset(phase_ticks)) / self.g

    def error(self, temp_c: float, phase_ticks: float, supply: float = 1.0) -> float:
        field = self._field(phase_ticks, supply)
        psi = 0.0
        for _ in range(FORWARD_ROUNDS):
            cosine = math.cos(psi)
            share = math.exp(-self._saturation(field * cosine * cosine))
            before, psi = psi, math.atan(((temp_c - self.t0) * share + self.delta) / self.w)
            if abs(psi - before) < 1e-13:
                break
        return self.g * psi + self._offset(phase_ticks)

    def invert(self, error: float, phase_ticks: float, supply: float = 1.0) -> tuple[float, float]:
        psi = (error - self._offset(phase_ticks)) / self.g
        if not -PSI_MAX_RAD < psi < PSI_MAX_RAD:
            return NAN_PAIR
        tangent, cosine = math.tan(psi), math.cos(psi)
        u = self._field(phase_ticks, supply) * cosine * cosine
        growth = math.exp(self._saturation(u))
        reach = self.w * tangent - self.delta
        # d(-ln S)/dpsi = (b + 4 q u^3) du/dpsi, du/dpsi = -2 u tan(psi)
        bend = (self.b + 4.0 * self.q * u * u * u) * 2.0 * u * tangent
        slope = growth * (self.w / (cosine * cosine) - reach * bend) / self.g
        return (self.t0 + reach * growth, slope) if slope > 0.0 else NAN_PAIR

    def rezeroed(self, temp_c: float, error: float, phase_ticks: float, supply: float = 1.0) -> TankLaw:
        psi = self.angle(error, phase_ticks)
        cosine = math.cos(psi)
        share = math.exp(-self._saturation(self._field(phase_ticks, supply) * cosine * cosine))
        return replace(self, delta=self.w * math.tan(psi) - (temp_c - self.t0) * share)


# By the name the config and the fits use.
LAWS: dict[str, type[ExpLaw] | type[Eq5Law] | type[TankLaw]] = {"exp": ExpLaw, "eq5": Eq5Law, "tank": TankLaw}


def law_of(name: str, coefficients: Mapping[str, float], residual_units: float | None = None) -> Law:
    """The law `name` with fitted coefficients (any letter case); a missing one keeps its default."""
    kind = LAWS[name]
    known = {field.name for field in fields(kind)}
    values = {key.lower(): float(value) for key, value in coefficients.items() if key.lower() in known}
    if residual_units is not None:
        values["residual_units"] = residual_units
    return kind(**values)


def coefficients_of(law: Law) -> tuple[str, dict[str, float]]:
    """(name, coefficients) of a law, the reverse of `law_of`; the residual is left out."""
    for name, kind in LAWS.items():
        if isinstance(law, kind):
            values = {f.name: float(getattr(law, f.name)) for f in fields(kind) if f.name != "residual_units"}
            return name, values
    raise TypeError(f"not a sensing law: {law!r}")
