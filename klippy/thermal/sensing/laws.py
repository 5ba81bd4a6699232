"""Sensing laws: signal units at a bridge phase to temperature and back, all inverted in closed form.

`ExpLaw` (default without a calibration), fitted to Table 1 of Oskolkov 2021 with p = (phase/45000)^2:

    error = a T exp(-b p) + c + d p          =>  T = (error - c - d p) / (a exp(-b p))

`Eq5Law`, eq 5 of Oskolkov 2021 with the coefficients of its Table 2, i = phase in ticks:

    error = A T + B i + AB T i + BB i^2 + ABB T i^2 + C
                                             =>  T = (error - C - B i - BB i^2) / (A + AB i + ABB i^2)

`TankLaw`, the phase psi of the coil current in an LCL tank (what INDUCTION_CALIBRATE fits). The tank's reactance is
linear in the coil's inductance, that in temperature; the steel saturates with the coil's field, which goes with
the drive s = sin(phi/2) and with cos(psi):

    error = g psi + c + d exp(-m p)          tan(psi) = [(T - t0) S(u) + delta] / w
    S(u)  = exp(-b u - q u^4)                u = (s cos(psi) V/V0)^2
                                             =>  T = t0 + (w tan(psi) - delta) / S(u)

An added table (LawTable) takes what that leaves: T = T_tank + added(phase, T_tank).

psi comes straight from the error, so u is known when T is asked for: no iteration on that side. `delta` is the detuning
(in degC): what a drifting capacitor or crystal moves, and what a one-point re-zero corrects.

`supply` is the bridge's voltage over the one the law was taken at; the field, and with it the saturation, goes with it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, ClassVar, Self

import chelper
from thermal.records import PHASE_MAX_TICKS

NO_COEFFICIENTS = ("residual_units", "table")  # of the laws' fields
TRUSTED_C = 10.0  # a drive at which the law errs by more is not used to heat
LEVELS_MAX, NODES_MAX = 16, 8  # of a table, as in thermal/sensing/laws.h
PSI_MAX_RAD = 1.35  # of the tank law, as in thermal/sensing/laws.c; the fits keep inside, too


class Law:
    """A sensing law, monotone in temperature at each phase. A frozen record of coefficients; the sums are C's."""

    __slots__ = ()
    KIND: ClassVar[int]  # thermal/sensing/laws.h's enum sensing_kind
    DRIFTING: ClassVar[str]  # the one number a one-point correction changes
    residual_units: float  # standard deviation of the fit, signal units

    def error(self, temp_c: float, phase_ticks: float, supply: float = 1.0) -> float:
        """Forwards: signal units at a temperature and phase."""
        law, lib = packed(self)
        return float(lib.sensing_error(law, temp_c, phase_ticks, supply))

    def invert(self, error: float, phase_ticks: float, supply: float = 1.0) -> tuple[float, float]:
        """(temperature in degC, dT/derror in degC per unit); two NaNs where the law has no answer."""
        law, lib = packed(self)
        found = lib.sensing_invert(law, error, phase_ticks, supply)
        return found.temp_c, found.c_per_unit

    def rezeroed(self, temp_c: float, error: float, phase_ticks: float, supply: float = 1.0) -> Self:
        """This law with its one drifting number changed so that `error` at this phase reads `temp_c`."""
        law, lib = packed(self)
        value = lib.sensing_rezeroed(law, temp_c, error, phase_ticks, supply)
        return replace(self, **{self.DRIFTING: value})  # type: ignore[type-var]

    def drifted(self, drift_c: float) -> Self:
        """This law for a thermometer whose reading at the sensing phase is off by `drift_c`; of the tank only."""
        return self


@lru_cache(maxsize=64)
def packed(law: Law) -> tuple[Any, Any]:
    """(C's struct sensing_law, the C helper)."""
    ffi, lib = chelper.get_ffi()
    values = {"kind": law.KIND, "phase_max_ticks": PHASE_MAX_TICKS, "k": list(_values(law).values())}
    table = getattr(law, "table", None)
    if table is not None:
        values |= {"levels": len(table.level_ticks), "nodes": len(table.node_c)}
        values |= {name: getattr(table, name) for name in ("level_ticks", "node_c", "added_c", "error_c")}
    return ffi.new("struct sensing_law *", values), lib


def _values(law: Law) -> dict[str, float]:
    """The coefficients by name, in C's order."""
    names = [f.name for f in fields(law) if f.name not in NO_COEFFICIENTS]  # type: ignore[arg-type]
    return {name: float(getattr(law, name)) for name in names}


@dataclass(frozen=True, slots=True)
class ExpLaw(Law):
    """error = a T exp(-b p) + c + d p. Coefficients: four-parameter fit of Table 1, s = 0.975 units."""

    KIND = 0
    DRIFTING = "c"
    a: float = 0.801361
    b: float = 1.058014
    c: float = 1.397019
    d: float = 5.139702
    residual_units: float = 0.975


@dataclass(frozen=True, slots=True)
class Eq5Law(Law):
    """Eq 5 of Oskolkov 2021, coefficients of Table 2. Residual 4.5-4.8 units, hence 6 degC at low power at best."""

    KIND = 1
    DRIFTING = "c"
    a: float = 0.825
    b: float = 0.0001081
    ab: float = -7.085e-06
    bb: float = 4.951e-10
    abb: float = -1.207e-10
    c: float = 0.797
    residual_units: float = 4.65


@dataclass(frozen=True, slots=True)
class LawTable:
    """What is added to the tank law's temperature: degC at each level of the drive and each of its temperatures.

    Between them it is bilinear, beyond them constant. Dead time and resistance of the steel bend the signal in
    ways that no formula of a few numbers follows.
    """

    level_ticks: tuple[float, ...]
    node_c: tuple[float, ...]
    added_c: tuple[tuple[float, ...], ...]
    error_c: tuple[float, ...]  # what is left at each level, 1 sigma

    def rows(self) -> list[tuple[float, ...]]:
        """As in the config: the temperatures behind two zeros, then each level with what is left and its values."""
        levels = zip(self.level_ticks, self.error_c, self.added_c, strict=True)
        return [(0.0, 0.0, *self.node_c), *((ticks, left, *row) for ticks, left, row in levels)]

    def trusted_ticks(self) -> float:
        """The strongest drive up to which the law is right within TRUSTED_C."""
        levels = zip(self.level_ticks, self.error_c, strict=True)
        return [ticks for ticks, _ in itertools.takewhile(lambda level: level[1] <= TRUSTED_C, levels)][-1]

    @staticmethod
    def of_rows(rows: Sequence[Sequence[float]]) -> LawTable:
        """Raises ValueError with a text for people."""
        widths = {len(row) for row in rows}
        if len(widths) != 1 or not 3 <= len(rows) <= LEVELS_MAX + 1 or not 4 <= min(widths) <= NODES_MAX + 2:
            raise ValueError(
                f"needs 2 to {LEVELS_MAX} rows below the first, of one length with 2 to {NODES_MAX} values each"
            )
        first, rest = rows[0], rows[1:]
        table = LawTable(
            tuple(row[0] for row in rest),
            tuple(first[2:]),
            tuple(tuple(row[2:]) for row in rest),
            tuple(row[1] for row in rest),
        )
        for what in (table.level_ticks, table.node_c):
            if any(b <= a for a, b in itertools.pairwise(what)):
                raise ValueError("drives (first column) and temperatures (first row) must ascend")
        if not 0.0 <= table.error_c[0] <= TRUSTED_C:
            raise ValueError(
                f"has an error of {table.error_c[0]:g} C at its smallest drive, where it must be right"
            )
        for added in table.added_c:
            read = [c + a for c, a in zip(table.node_c, added, strict=True)]
            if any(b <= a for a, b in itertools.pairwise(read)):
                raise ValueError("makes the reading fall with rising temperature")
        return table


@dataclass(frozen=True, slots=True)
class TankLaw(Law):
    """The phasor law (docs/theory/Induction.md). Defaults fit Table 1 of Oskolkov 2021: 28 points, s = 1.03 units."""

    KIND = 2
    DRIFTING = "delta"
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
    table: LawTable | None = None

    def drifted(self, drift_c: float) -> Self:
        return replace(self, delta=self.delta + drift_c) if drift_c else self


# By the name the config and the fits use.
LAWS: dict[str, type[ExpLaw] | type[Eq5Law] | type[TankLaw]] = {"exp": ExpLaw, "eq5": Eq5Law, "tank": TankLaw}


def law_of(
    name: str,
    coefficients: Mapping[str, float],
    residual_units: float | None = None,
    table: LawTable | None = None,
) -> Law:
    """The law `name` with fitted coefficients (any letter case); a missing one keeps its default."""
    kind = LAWS[name]
    known = {field.name for field in fields(kind)} - set(NO_COEFFICIENTS)
    values: dict[str, Any] = {
        key.lower(): float(value) for key, value in coefficients.items() if key.lower() in known
    }
    if residual_units is not None:
        values["residual_units"] = residual_units
    if kind is TankLaw:
        values["table"] = table
    return kind(**values)


def coefficients_of(law: Law) -> tuple[str, dict[str, float]]:
    """(name, coefficients) of a law, the reverse of `law_of`; residual and table are left out."""
    for name, kind in LAWS.items():
        if isinstance(law, kind):
            return name, _values(law)
    raise TypeError(f"not a sensing law: {law!r}")
