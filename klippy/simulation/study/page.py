"""The page of a study: limits, worst prints, distributions and sensitivity, in one HTML file without outside parts."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from .analysis import Influence, Verdict, values_of
from .results import Rows
from .studyfile import ENDINGS, VARIANT, Limit

WIDTH, HEIGHT, BINS = 360, 110, 30
WORST_SHOWN = 5
_NUMBER = re.compile(r"-?\d+(\.\d+)?")  # in reasons, which are counted without their figures
TEMPLATE = Path(__file__).with_name("page.html")


@dataclass(frozen=True, slots=True)
class Content:
    """What the page shows. `reports`: keys that have a report in the folder runs/."""

    title: str
    version: str
    points: Mapping[str, Mapping[str, Any]]
    rows: Rows
    figures: Sequence[str]
    verdicts: Sequence[Verdict]
    influences: Sequence[Influence]
    reports: frozenset[str]


def render(content: Content) -> str:
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["figure"] = _text
    environment.filters["short"] = _short_names(next(iter(content.points.values()), {})).__getitem__
    statuses = Counter(row["status"] for _, row in sorted(content.rows.items()))
    bad = [row for _, row in sorted(content.rows.items()) if row["status"] != "printed"]
    endings = Counter((row["status"], _NUMBER.sub("…", row["reason"])) for row in bad).most_common()
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        c=content,
        statuses=statuses,
        reasons=endings,
        distributions=list(_distributions(content)),
        shown=WORST_SHOWN,
        endings=ENDINGS,
    )


def _distributions(content: Content) -> Iterator[tuple[str, dict[str, float], str]]:
    """Name, statistics and picture of each figure, by variant."""
    limits = {(verdict.limit.figure, verdict.limit.variant): verdict.limit for verdict in content.verdicts}
    variants = sorted({str(point.get(VARIANT, "")) for point in content.points.values()})
    for figure in content.figures:
        for variant in variants:
            own = {k: r for k, r in content.rows.items() if content.points[k].get(VARIANT, "") == variant}
            values = values_of(own, figure)
            if values:
                limit = limits.get((figure, variant)) or limits.get((figure, ""))
                name = f"{figure} ({variant})" if variant else figure
                yield name, _statistics(values), histogram(values, limit)


def _text(value: Any) -> str:
    return "–" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _short_names(names: Iterable[str]) -> dict[str, str]:
    """Parameters by the option's name alone where no two sections share it."""
    options = [name.rpartition(".")[2] for name in names]
    return {n: n if options.count(o) > 1 else o for n, o in zip(names, options, strict=True)}


def _statistics(values: Sequence[float]) -> dict[str, float]:
    quantiles = np.percentile(values, (0, 5, 50, 95, 99, 100))
    return dict(zip(("min", "5 %", "median", "95 %", "99 %", "max"), map(float, quantiles), strict=True))


def histogram(values: Sequence[float], limit: Limit | None) -> str:
    """An SVG picture; the limits are upright lines."""
    low, high = min(values), max(values)
    if low == high:
        low, high = low - 0.5, high + 0.5
    counts, _ = np.histogram(values, BINS, (low, high))
    bar = WIDTH / BINS
    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT + 16}" width="{WIDTH}" height="{HEIGHT + 16}">']
    for number, count in enumerate(counts):
        tall = HEIGHT * count / max(counts)
        parts.append(
            f'<rect x="{number * bar:.1f}" y="{HEIGHT - tall:.1f}" width="{bar - 1:.1f}" height="{tall:.1f}"/>'
        )
    for bound in (limit.min, limit.max) if limit else ():
        if bound is not None and low <= bound <= high:
            x = WIDTH * (bound - low) / (high - low)
            parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{HEIGHT}"/>')
    parts.append(f'<text x="0" y="{HEIGHT + 13}">{low:.4g}</text>')
    parts.append(f'<text x="{WIDTH}" y="{HEIGHT + 13}" text-anchor="end">{high:.4g}</text></svg>')
    return "".join(parts)
