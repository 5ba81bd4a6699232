"""Input shapers: rows of impulses after which an oscillation of known frequency and damping is gone.

With the natural frequency f and the damping ratio z the damped period is T = 1/(f sqrt(1 - z^2)), and half of it damps
an oscillation by K = exp(-z pi/sqrt(1 - z^2)). Amplitudes sum to 1.

  zv, zvd    impulses T/2 apart that cancel each other, and that twice over (Singer 1990, eqs 9 and 12)
  mzv        n impulses evenly over t periods (below)
  ei         Singhose 1997: at most `v_tol` of the vibration stays at f, none at two frequencies
             beside it. No closed form exists with damping; their published fit is for z of 0 to 0.3
  2hump_ei, 3hump_ei   the same with more such frequencies, for 5 %; their fit has its times in periods 1/f

The fits' sums differ from 1 by up to 0.0005: every shaper is normalised.

mzv is a zero-placement shaper (Tuttle 1994). Impulses a delay d = tT/(n - 1) apart make the polynomial
A0 + A1 s + ... + A(n-1) s^(n-1) in s = exp(j w d). Its zeros lie on the unit circle: the first at phi = 2 pi t/(n - 1)
(the oscillation itself), its mirror image at -phi, and the other n - 3 evenly between those, far from the signal. With
damping the amplitude at time x is lower by exp(-2 pi z x/sqrt(1 - z^2)), so that the zero falls on the damped pole.

`parse` reads a type as printer.cfg has it: "mzv", "mzv(n=4)", "mzv(5,0.6)", "ei(v_tol=0.02)".
"""

from __future__ import annotations

import cmath
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

Impulses = tuple[list[float], list[float]]  # amplitudes, times
Arguments = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of a shaper type."""

    name: str
    default: float
    min: float
    max: float
    is_integer: bool = False


@dataclass(frozen=True, slots=True)
class ShaperType:
    """A family of shapers; a calibration looks for frequencies from `min_hz` on."""

    name: str
    impulses: Callable[[float, Arguments], Impulses]
    min_hz: float
    max_damping_ratio: float
    parameters: tuple[Parameter, ...] = ()
    undamped_periods: bool = False  # the times of `impulses` are in periods 1/f, not in damped ones


@dataclass(frozen=True, slots=True)
class Shaper:
    """A type with the values of its parameters. `text` is as the user wrote it."""

    kind: ShaperType
    arguments: tuple[tuple[str, float], ...]
    text: str

    def impulses(self, damping_ratio: float) -> Impulses:
        """Amplitudes with sum 1, times in periods 1/f from 0 on."""
        amplitudes, times = self.kind.impulses(damping_ratio, dict(self.arguments))
        if not self.kind.undamped_periods:
            times = [t / math.sqrt(1.0 - damping_ratio**2) for t in times]
        total = sum(amplitudes)
        return [a / total for a in amplitudes], times

    def pulses(self, frequency_hz: float, damping_ratio: float) -> Impulses:
        """The impulses with their times in seconds."""
        amplitudes, times = self.impulses(damping_ratio)
        return amplitudes, [t / frequency_hz for t in times]


def _half_period_damping(z: float) -> float:
    return math.exp(-z * math.pi / math.sqrt(1.0 - z * z))


def _zv(z: float, _: Arguments) -> Impulses:
    return [1.0, _half_period_damping(z)], [0.0, 0.5]


def _zvd(z: float, _: Arguments) -> Impulses:
    k = _half_period_damping(z)
    return [1.0, 2.0 * k, k * k], [0.0, 0.5, 1.0]


def _mzv(z: float, arguments: Arguments) -> Impulses:
    n, t = round(arguments["n"]), arguments["t"]
    first = 2.0 * math.pi * t / (n - 1)
    apart = (2.0 * math.pi - 2.0 * first) / (n - 2)
    coefficients: list[complex] = [1.0]
    for number in range(n - 1):
        zero = cmath.exp(1j * (first + number * apart))
        coefficients = [a - zero * b for a, b in zip([*coefficients, 0.0], [0.0, *coefficients], strict=True)]
    times = [t * i / (n - 1) for i in range(n)]
    damping = _half_period_damping(z)
    # Times in damped periods: two halves to a period.
    return [c.real * damping ** (2.0 * x) for c, x in zip(coefficients, times, strict=True)], times


def _polynomial(row: Sequence[float], x: float) -> float:
    return sum(c * x**power for power, c in enumerate(row))


def _ei(z: float, arguments: Arguments) -> Impulses:
    """Singhose 1997, table 1, the fit for one hump."""
    v = arguments["v_tol"]
    a1 = _polynomial((0.24968 + 0.24961 * v, 0.80008 + 1.23328 * v, 0.49599 + 3.17316 * v), z)
    a3 = _polynomial((0.25149 + 0.21474 * v, -0.83249 + 1.41498 * v, 0.85181 - 4.90094 * v), z)
    middle = (
        0.49990,
        0.46159 * v + 8.57843 * v * v,
        4.26169 * v - 108.644 * v * v,
        1.75601 * v + 336.989 * v * v,
    )
    return [a1, 1.0 - (a1 + a3), a3], [0.0, _polynomial(middle, z), 1.0]


Rows = tuple[tuple[float, float, float, float], ...]
# Singhose 1997, tables 2 and 3: coefficients of 1, z, z^2, z^3 for amplitudes, and for the times after the first.
_TWO_HUMPS: tuple[Rows, Rows] = (
    (
        (0.16054, 0.76699, 2.26560, -1.22750),
        (0.33911, 0.45081, -2.58080, 1.73650),
        (0.34089, -0.61533, -0.68765, 0.42261),
        (0.15997, -0.60246, 1.00280, -0.93145),
    ),
    (
        (0.49890, 0.16270, -0.54262, 6.16180),
        (0.99748, 0.18382, -1.58270, 8.17120),
        (1.49920, -0.09297, -0.28338, 1.85710),
    ),
)
_THREE_HUMPS: tuple[Rows, Rows] = (
    (
        (0.11275, 0.76632, 3.29160, -1.44380),
        (0.23698, 0.61164, -2.57850, 4.85220),
        (0.30008, -0.19062, -2.14560, 0.13744),
        (0.23775, -0.73297, 0.46885, -2.08650),
        (0.11244, -0.45439, 0.96382, -1.46000),
    ),
    (
        (0.49974, 0.23834, 0.44559, 12.4720),
        (0.99849, 0.29808, -2.36460, 23.3990),
        (1.49870, 0.10306, -2.01390, 17.0320),
        (1.99960, -0.28231, 0.61536, 5.40450),
    ),
)


def _fit(tables: tuple[Rows, Rows], z: float) -> Impulses:
    amplitudes, times = tables
    return [_polynomial(row, z) for row in amplitudes], [0.0, *(_polynomial(row, z) for row in times)]


SHAPERS: dict[str, ShaperType] = {
    kind.name: kind
    for kind in (
        ShaperType("zv", _zv, 21.0, 0.99),
        ShaperType(
            "mzv",
            _mzv,
            23.0,
            0.99,
            (Parameter("n", 3, 3, 8, is_integer=True), Parameter("t", 0.75, 0.5, 1.0)),
        ),
        ShaperType("zvd", _zvd, 29.0, 0.99),
        ShaperType("ei", _ei, 29.0, 0.4, (Parameter("v_tol", 0.05, 0.0, 0.15),)),
        ShaperType("2hump_ei", lambda z, _: _fit(_TWO_HUMPS, z), 39.0, 0.3, undamped_periods=True),
        ShaperType("3hump_ei", lambda z, _: _fit(_THREE_HUMPS, z), 48.0, 0.2, undamped_periods=True),
    )
}
_TEXT = re.compile(r"\s*(?P<name>[0-9a-z_]+)\s*(?:\((?P<arguments>[^()]*)\))?\s*")


def parse(text: str) -> Shaper:
    """The shaper of a type's text. Raises ValueError with what would be right."""
    match = _TEXT.fullmatch(text.lower())
    kind = SHAPERS.get(match["name"]) if match else None
    if match is None or kind is None:
        raise ValueError(f"'{text}' is not a shaper type; types are {', '.join(SHAPERS)}")
    values = {p.name: p.default for p in kind.parameters}
    given = [part.strip() for part in (match["arguments"] or "").split(",") if part.strip()]
    if len(given) > len(kind.parameters):
        raise ValueError(f"'{text}' has too many parameters; {_describe(kind)}")
    for parameter, part in zip(kind.parameters, given, strict=False):
        name, is_named, number = (word.strip() for word in part.rpartition("="))
        chosen = next((p for p in kind.parameters if p.name == name), None) if is_named else parameter
        if chosen is None:
            raise ValueError(f"'{text}' has an unknown parameter '{name}'; {_describe(kind)}")
        values[chosen.name] = _number(text, chosen, number)
    return Shaper(kind, tuple(values.items()), match[0].replace(" ", ""))


def _describe(kind: ShaperType) -> str:
    if not kind.parameters:
        return f"{kind.name} has none"
    rows = (f"{p.name} ({p.min:g} to {p.max:g}, default {p.default:g})" for p in kind.parameters)
    return f"{kind.name} has {', '.join(rows)}"


def _number(text: str, parameter: Parameter, given: str) -> float:
    try:
        value = float(given)
    except ValueError:
        value = math.nan
    if not parameter.min <= value <= parameter.max or (parameter.is_integer and value != round(value)):
        what = "a whole number" if parameter.is_integer else "a number"
        raise ValueError(
            f"'{text}': {parameter.name} must be {what} from {parameter.min:g} to {parameter.max:g}"
        )
    return value


def check_damping(shaper: Shaper, damping_ratio: float) -> None:
    """Raises ValueError where a type's fit does not hold."""
    if damping_ratio > shaper.kind.max_damping_ratio:
        raise ValueError(
            f"shaper {shaper.kind.name} holds for a damping ratio up to {shaper.kind.max_damping_ratio:g},"
            f" not {damping_ratio:g}"
        )
