"""From a plan and distributions to points: for each parameter one value, as text for the config.

A plan yields numbers from 0 to 1, one for each parameter; the inverse of the distribution function makes the value of
each. Values have nine significant digits: they are in commands and in hashes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from .formula import evaluate

KINDS = ("grid", "lhs", "sobol", "saltelli")
# Distribution → arguments it needs, arguments it may have
DISTRIBUTIONS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "uniform": (("low", "high"), ()),
    "loguniform": (("low", "high"), ()),
    "normal": (("mean", "sd"), ("low", "high")),
    "choice": (("values",), ()),
}
EDGE = 1e-9  # an unbounded normal distribution ends here: 6 standard deviations


@dataclass(frozen=True, slots=True)
class Plan:
    """`runs`: points of lhs and sobol; points of each of the matrices of saltelli."""

    kind: str
    runs: int
    seed: int


@dataclass(frozen=True, slots=True)
class Parameter:
    """`section.option`, or the name of a draw. `relative`: the value is times that of the config; `steps`: points in a
    grid; a `formula` has the draws of its point.

    With `sets` the name has no section, and a value is the name of a set: option → value.
    """

    name: str
    kind: str
    arguments: Mapping[str, Any]
    relative: bool = False
    steps: int = 0
    sets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def levels(self) -> int:
        """How many values it has in a grid."""
        if self.kind == "formula":
            return 1
        return len(self.arguments["values"]) if self.kind in ("choice", "constant") else self.steps

    @property
    def varies(self) -> bool:
        return self.kind not in ("constant", "formula")

    def value(self, share: float) -> float | str:
        """The value below which this share of the distribution lies."""
        a = self.arguments
        if self.kind in ("choice", "constant"):
            values = a["values"]
            return values[min(len(values) - 1, int(share * len(values)))]
        if self.kind == "uniform":
            return a["low"] + share * (a["high"] - a["low"])
        if self.kind == "loguniform":
            return math.exp(math.log(a["low"]) + share * math.log(a["high"] / a["low"]))
        from scipy.special import ndtr, ndtri

        low, high = (EDGE, 1.0 - EDGE)
        if a["low"] is not None:
            low = float(ndtr((a["low"] - a["mean"]) / a["sd"]))
        if a["high"] is not None:
            high = float(ndtr((a["high"] - a["mean"]) / a["sd"]))
        return float(a["mean"] + a["sd"] * ndtri(low + share * (high - low)))


def shares(plan: Plan, parameters: Sequence[Parameter]) -> Iterator[tuple[float, ...]]:
    """The plan's points, 0 to 1 for each parameter."""
    if plan.kind == "grid":
        levels = [parameter.levels for parameter in parameters]
        for steps in itertools.product(*(range(count) for count in levels)):
            yield tuple(
                (i + 0.5) / count if p.kind in ("choice", "constant", "formula") else i / (count - 1)
                for i, count, p in zip(steps, levels, parameters, strict=True)
            )
        return
    from scipy.stats import qmc

    varied = [number for number, p in enumerate(parameters) if p.varies]
    count = len(varied)
    if plan.kind == "lhs":
        rows = qmc.LatinHypercube(count, rng=plan.seed).random(plan.runs)
    elif plan.kind == "sobol":
        rows = qmc.Sobol(count, rng=plan.seed).random(plan.runs)
    else:
        rows = _saltelli(qmc.Sobol(2 * count, rng=plan.seed).random(plan.runs), count)
    for row in rows:
        point = [0.5] * len(parameters)
        for number, share in zip(varied, row, strict=True):
            point[number] = float(share)
        yield tuple(point)


def _saltelli(both: Any, count: int) -> Iterator[list[float]]:
    """Matrix A, matrix B, then for each parameter A with that column of B (Saltelli 2010, Table 2)."""
    a, b = both[:, :count], both[:, count:]
    yield from a
    yield from b
    for column in range(count):
        mixed = a.copy()
        mixed[:, column] = b[:, column]
        yield from mixed


def points(
    plan: Plan, parameters: Sequence[Parameter], base: Mapping[str, float]
) -> Iterator[dict[str, float | str]]:
    """Name → value for each point. `base`: the config's values of the relative parameters."""
    for row in shares(plan, parameters):
        point: dict[str, float | str] = {}
        for parameter, share in zip(parameters, row, strict=True):
            if parameter.kind == "formula":
                value = evaluate(parameter.arguments["formula"], draws_of(point))
            else:
                value = parameter.value(share)
            if parameter.relative:
                value = base[parameter.name] * float(value)
            point[parameter.name] = float(f"{value:.9g}") if isinstance(value, float) else value
        yield point


def draws_of(point: Mapping[str, float | str]) -> dict[str, float]:
    """The draws of a point: numbers with names without a section."""
    numbers = {name: value for name, value in point.items() if not isinstance(value, str)}
    return {name: float(value) for name, value in numbers.items() if "." not in name}
