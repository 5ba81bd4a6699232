"""[thermistor NAME] and the built-in thermistor types.

    reference ── pullup_resistor ──┬── ADC   ratio = R / (R + pull-up),  R = inline + thermistor (|| parallel_resistor)
                                   └── inline ──┬── thermistor ──┬── ground
                                                └── (parallel) ──┘

Three curves. Beta:  1/T = 1/T1 + ln(R/R1)/beta.   Three points, Steinhart-Hart:  1/T = c1 + c2 ln R + c3 (ln R)^3.
Four points and more: a table, between whose rows ln R is linear in 1/T (a beta of its own for each step).

The parallel resistor flattens the divider's curve (HydraRaptor notes 2007: more resolution where it prints, less where
it is cold).
"""

from __future__ import annotations

import bisect
import itertools
import math
from dataclasses import dataclass
from typing import Any, Protocol

from configfile import ConfigWrapper

from . import adc_temperature
from .adc_temperature import PrinterADCtoTemperature

ZERO_CELSIUS_K = 273.15
RATIO_LOW, RATIO_HIGH = 1e-5, 1.0 - 1e-5  # keeps the logarithm finite at an open or shorted sensor
LN_OHM_MAX = 300.0  # what min_temp near absolute zero would need no number can hold
HOTTEST_INVERSE_K = 1.0 / 2273.15  # a shorted sensor reads as 2000 degC, where the law itself has a pole
BETA_MIN_K, BETA_MAX_K = 500.0, 20000.0  # parts have 2000 to 6000


def _ohm(ln_ohm: float) -> float:
    return math.exp(min(LN_OHM_MAX, max(-LN_OHM_MAX, ln_ohm)))


class Law(Protocol):
    """A thermistor without its circuit."""

    def temp_c(self, ohm: float) -> float: ...
    def ohm(self, temp_c: float) -> float: ...


@dataclass(frozen=True, slots=True)
class SteinhartHart:
    """Coefficients of 1/T[K] = c1 + c2 ln R + c3 (ln R)^3; c3 = 0 is the beta equation."""

    c1: float
    c2: float
    c3: float = 0.0

    def temp_c(self, ohm: float) -> float:
        """Temperature of a resistance."""
        ln_r = math.log(ohm)
        inverse_t = self.c1 + self.c2 * ln_r + self.c3 * ln_r**3
        return 1.0 / max(inverse_t, HOTTEST_INVERSE_K) - ZERO_CELSIUS_K

    def ohm(self, temp_c: float) -> float:
        """Resistance at a temperature: the one real root of the cubic in ln R (Cardano)."""
        inverse_t = 1.0 / (temp_c + ZERO_CELSIUS_K)
        if not self.c3:
            return _ohm((inverse_t - self.c1) / self.c2)
        third = self.c2 / (3.0 * self.c3)
        half = 0.5 * (self.c1 - inverse_t) / self.c3
        root = math.sqrt(half * half + third**3)
        return _ohm(math.cbrt(root - half) - math.cbrt(root + half))


def fit_beta(temp1_c: float, ohm1: float, beta_k: float) -> SteinhartHart:
    """Curve through one point with a beta value."""
    c2 = 1.0 / beta_k
    return SteinhartHart(1.0 / (temp1_c + ZERO_CELSIUS_K) - c2 * math.log(ohm1), c2)


def fit_points(points: tuple[tuple[float, float], ...]) -> SteinhartHart:
    """Curve through three (degC, ohm) points. Raises ValueError if they cannot belong to one thermistor.

    Newton's divided differences in x = ln R; the x^2 term that they leave must vanish, which fixes c3.
    """
    ordered = sorted(points)
    x = [math.log(ohm) for _, ohm in ordered]
    y = [1.0 / (temp + ZERO_CELSIUS_K) for temp, _ in ordered]
    if not (ordered[0][0] < ordered[1][0] < ordered[2][0] and x[0] > x[1] > x[2]):
        raise ValueError("resistance must fall with temperature, at three different temperatures")
    slope_01 = (y[1] - y[0]) / (x[1] - x[0])
    slope_02 = (y[2] - y[0]) / (x[2] - x[0])
    c3 = (slope_02 - slope_01) / ((x[2] - x[1]) * (x[0] + x[1] + x[2]))
    if c3 <= 0.0:
        # The points are straighter than the law allows; a beta through the outer two is the nearest honest
        # curve.
        return fit_beta(ordered[0][0], ordered[0][1], 1.0 / slope_02)
    c2 = slope_01 - c3 * (x[0] * x[0] + x[0] * x[1] + x[1] * x[1])
    if c2 <= 0.0:
        raise ValueError("the three points bend more than any thermistor does")
    return SteinhartHart(y[0] - c2 * x[0] - c3 * x[0] ** 3, c2, c3)


class Table:
    """Rows of (degC, ohm), resistance falling with temperature; the end steps are prolonged."""

    def __init__(self, rows: tuple[tuple[float, float], ...]) -> None:
        """Raises ValueError if the rows cannot belong to one thermistor."""
        ordered = sorted(rows)
        for (temp0_c, ohm0), (temp1_c, ohm1) in itertools.pairwise(ordered):
            if temp0_c == temp1_c:
                raise ValueError(f"two rows are for {temp0_c:g} degrees")
            if ohm1 >= ohm0:
                raise ValueError(
                    f"resistance must fall with temperature, it does not from {temp0_c:g} to {temp1_c:g} degrees"
                )
        # by rising ln R: bisect needs ascending keys
        self._ln_r = [math.log(ohm) for _, ohm in reversed(ordered)]
        self._inverse_t = [1.0 / (temp_c + ZERO_CELSIUS_K) for temp_c, _ in reversed(ordered)]

    def temp_c(self, ohm: float) -> float:
        """Temperature of a resistance."""
        inverse_t = self._between(self._ln_r, self._inverse_t, math.log(ohm))
        return 1.0 / max(inverse_t, HOTTEST_INVERSE_K) - ZERO_CELSIUS_K

    def ohm(self, temp_c: float) -> float:
        """Resistance at a temperature."""
        return _ohm(self._between(self._inverse_t, self._ln_r, 1.0 / (temp_c + ZERO_CELSIUS_K)))

    @staticmethod
    def _between(x: list[float], y: list[float], at: float) -> float:
        i = min(max(bisect.bisect_right(x, at), 1), len(x) - 1)
        return y[i - 1] + (at - x[i - 1]) * (y[i] - y[i - 1]) / (x[i] - x[i - 1])


class Thermistor:
    """The curve with its circuit: ADC ratio to degC and back. Plugins give the two resistors, then set the curve."""

    def __init__(
        self, pullup: float, inline_resistor: float, law: Law | None = None, parallel_ohm: float = math.inf
    ) -> None:
        self.pullup = pullup
        self.inline_resistor = inline_resistor
        self._law = law
        self._parallel_siemens = 1.0 / parallel_ohm

    @property
    def law(self) -> Law:
        """The curve. Raises ValueError if there is none yet."""
        if self._law is None:
            raise ValueError(
                "this thermistor has no curve: call setup_coefficients or setup_coefficients_beta"
            )
        return self._law

    def setup_coefficients(
        self, t1: float, r1: float, t2: float, r2: float, t3: float, r3: float, name: str = ""
    ) -> None:
        """Curve through three points, degC and ohm. Raises ValueError if they cannot belong to one thermistor."""
        try:
            self._law = fit_points(((t1, r1), (t2, r2), (t3, r3)))
        except ValueError as e:
            raise ValueError(f"{name or 'thermistor'}: {e}") from None

    def setup_coefficients_beta(self, t1: float, r1: float, beta: float) -> None:
        """Curve through one point with a beta value."""
        self._law = fit_beta(t1, r1, beta)

    def calc_temp(self, adc: float) -> float:
        ratio = min(RATIO_HIGH, max(RATIO_LOW, adc))
        load_ohm = max(self.pullup * ratio / (1.0 - ratio) - self.inline_resistor, 1e-3)
        siemens = 1.0 / load_ohm - self._parallel_siemens
        return self.law.temp_c(1.0 / max(siemens, 1e-9))  # a load above the parallel resistor: an open sensor

    def calc_adc(self, temp: float) -> float:
        ohm = math.inf if temp <= -ZERO_CELSIUS_K else self.law.ohm(temp)
        siemens = 1.0 / ohm + self._parallel_siemens
        if not siemens:
            return 1.0
        load_ohm = 1.0 / siemens + self.inline_resistor
        return load_ohm / (load_ohm + self.pullup)


@dataclass(frozen=True, slots=True)
class BetaPart:
    """A part by its R25 and beta, and where those are printed."""

    ohm_25c: float
    beta_k: float
    origin: str


_BETA_PARTS = {
    "EPCOS 100K B57560G104F": BetaPart(100e3, 4092.0, "TDK/EPCOS B57560G datasheet, B25/100"),
    "ATC Semitec 104GT-2": BetaPart(100e3, 4267.0, "Semitec GT datasheet, B25/85"),
    "ATC Semitec 104NT-4-R025H42G": BetaPart(100e3, 4267.0, "Semitec NT-4 as sold by E3D, B25/85"),
    "Generic 3950": BetaPart(100e3, 3950.0, "the name: 100 kohm, B 3950"),
    "Honeywell 100K 135-104LAG-J01": BetaPart(100e3, 3974.0, "Honeywell 135 series datasheet, B25/85"),
    "NTC 100K MGB18-104F39050L32": BetaPart(100e3, 3950.0, "part code 104 F 3950"),
    "TDK NTCG104LH104JT1": BetaPart(100e3, 4485.0, "TDK NTCG datasheet, B25/50"),
}

# Three points as the maker publishes them (Slice Engineering, RTD/thermistor support page).
_POINT_PARTS = {
    "SliceEngineering 450": ((25.0, 500000.0), (200.0, 3734.0), (400.0, 240.0)),
}


def build_sensor(config: ConfigWrapper, law: Law) -> PrinterADCtoTemperature:
    """Sensor of a section that uses this thermistor."""
    curve = Thermistor(
        config.getfloat("pullup_resistor", 4700.0, above=0.0),
        config.getfloat("inline_resistor", 0.0, minval=0.0),
        law,
        config.getfloat("parallel_resistor", math.inf, above=0.0),
    )
    return adc_temperature.build_sensor(config, PrinterADCtoTemperature, curve)


def register_builtin(heaters: Any) -> None:
    """Register the types built in here."""
    laws: dict[str, Law] = {
        name: fit_beta(25.0, part.ohm_25c, part.beta_k) for name, part in _BETA_PARTS.items()
    }
    laws.update({name: fit_points(points) for name, points in _POINT_PARTS.items()})
    for name, law in laws.items():
        heaters.add_sensor_factory(name, lambda config, law=law: build_sensor(config, law))


def read_law(config: ConfigWrapper) -> Law:
    """Curve of a [thermistor] section: by beta, by three points, or by a table of more."""
    above_zero_k = -ZERO_CELSIUS_K
    temp1_c = config.getfloat("temperature1", above=above_zero_k)
    ohm1 = config.getfloat("resistance1", above=0.0)
    beta_k = config.getfloat("beta", None, minval=BETA_MIN_K, maxval=BETA_MAX_K)
    if beta_k is not None:
        return fit_beta(temp1_c, ohm1, beta_k)
    points = [(temp1_c, ohm1)]
    for n in itertools.count(2):
        if n > 3 and config.get(f"temperature{n}", None) is None:
            break
        temp_c = config.getfloat(f"temperature{n}", above=above_zero_k)
        points.append((temp_c, config.getfloat(f"resistance{n}", above=0.0)))
    try:
        return fit_points(tuple(points)) if len(points) == 3 else Table(tuple(points))
    except ValueError as e:
        raise config.error(f"Thermistor in section '{config.get_name()}': {e}") from None


def load_config_prefix(config: ConfigWrapper) -> None:
    """A custom thermistor: its name becomes a sensor_type."""
    law = read_law(config)
    heaters = config.get_printer().load_object(config, "heaters")
    name = " ".join(config.get_name().split()[1:])
    heaters.add_sensor_factory(name, lambda c: build_sensor(c, law))
