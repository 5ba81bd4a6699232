"""What the table says: limits met or not, worst prints, and which parameters matter.

Rank correlation: Spearman's rho of each parameter with each figure, for any plan.
Sobol indices, for a saltelli plan: first order by Saltelli 2010, Table 2 (b), total by Jansen (f).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .prepare import Prepared
from .results import Rows
from .studyfile import ENDINGS, PRINTED, VARIANT, Limit

MIN_ROWS = 5  # below, a rank correlation says nothing


@dataclass(frozen=True, slots=True)
class Verdict:
    """A limit and what came out: `share` of the prints within it, `worst` key first."""

    limit: Limit
    share: float
    met: bool
    worst: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Influence:
    """Of a parameter on a figure: rho; first-order and total index if the plan is made for them."""

    parameter: str
    figure: str
    rho: float | None
    first: float | None = None
    total: float | None = None


def excess(limit: Limit, value: float | None) -> float:
    """How far a value is beyond the limit, the unit of the figure; negative within it."""
    if value is None or math.isnan(value):
        return math.inf
    above = value - limit.max if limit.max is not None else -math.inf
    below = limit.min - value if limit.min is not None else -math.inf
    return max(above, below)


def judge(limits: Sequence[Limit], rows: Rows, prepared: Prepared | None = None) -> list[Verdict]:
    """Limits of figures are for the prints that ended well; how many those are has a limit of its own. `prepared`: for
    limits of a variant.
    """
    verdicts = []
    for limit in limits:
        keys = sorted(rows)
        if limit.variant and prepared:
            keys = [key for key in keys if prepared.points[key][VARIANT] == limit.variant]
        if limit.figure in ENDINGS:
            ended = [key for key in keys if rows[key]["status"] in ENDINGS[limit.figure]]
            share = len(ended) / max(1, len(keys))
            worst = set(keys) - set(ended) if limit.figure == PRINTED else ended
            verdicts.append(Verdict(limit, share, excess(limit, share) <= 0.0, tuple(sorted(worst))))
            continue
        good = [key for key in keys if rows[key]["status"] == "printed"]
        over = {key: excess(limit, _value(limit, key, rows, prepared)) for key in good}
        share = sum(value <= 0.0 for value in over.values()) / max(1, len(over))
        ranked = sorted(over, key=lambda key: (-over[key], key))
        verdicts.append(Verdict(limit, share, bool(over) and share >= limit.share, tuple(ranked)))
    return verdicts


def _value(limit: Limit, key: str, rows: Rows, prepared: Prepared | None) -> float | None:
    value: float | None = rows[key]["figures"].get(limit.figure)
    if not limit.of or prepared is None:
        return value
    other = rows.get(prepared.twins[key][limit.of], {}).get("figures", {}).get(limit.figure)
    return value / other if value is not None and other else None


def values_of(rows: Rows, figure: str) -> list[float]:
    """The figure in all prints that have it, in the order of the keys."""
    found = [rows[key]["figures"].get(figure) for key in sorted(rows)]
    return [float(value) for value in found if value is not None]


def influences(
    order: Sequence[str],
    points: Mapping[str, Mapping[str, Any]],
    rows: Rows,
    figures: Sequence[str],
    names: Sequence[str],
    base: int,
) -> list[Influence]:
    """Strongest first for each figure.

    `order`: keys in the order of the plan, once for each file and seed; `names`: parameters that vary; `base`: points
    of a saltelli matrix, else 0.
    """
    from scipy.stats import rankdata

    found = []
    for figure in figures:
        known = [key for key in sorted(rows) if rows[key]["figures"].get(figure) is not None]
        y = [rows[key]["figures"][figure] for key in known]
        if len(set(y)) < 2 or len(y) < MIN_ROWS:
            continue
        indices = _sobol([rows[key]["figures"].get(figure) for key in order], base, len(names))
        ranks = rankdata(y)
        some = []
        for name, (first, total) in zip(names, indices, strict=True):
            values = [points[key][name] for key in known]
            numbers = all(isinstance(value, int | float) for value in values) and len(set(values)) > 1
            rho = float(np.corrcoef(rankdata(values), ranks)[0, 1]) if numbers else None
            some.append(Influence(name, figure, rho, first, total))
        found += sorted(some, key=lambda one: -abs(one.total if one.total is not None else one.rho or 0.0))
    return found


def _sobol(
    y: Sequence[float | None], base: int, count: int
) -> list[tuple[float, float]] | list[tuple[None, None]]:
    """(first order, total) of the mean over files and seeds; none if the plan is another or a print has no figure."""
    if not base or any(value is None for value in y):
        return [(None, None)] * count
    mean = np.array(y, dtype=float).reshape(-1, count + 2, base).mean(axis=0)
    a, b, *mixed = mean
    variance = np.var(np.concatenate([a, b]))
    if variance == 0.0:
        return [(None, None)] * count
    return [
        (float(np.mean(b * (ab - a)) / variance), float(np.mean((a - ab) ** 2) / (2.0 * variance)))
        for ab in mixed
    ]
