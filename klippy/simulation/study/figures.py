"""Figures of one print, from its summary and its trace."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

_NAME = re.compile(r"[a-z]\w*")
_COMPARE = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}


def collect(
    figures: Mapping[str, Mapping[str, Any]], summary: Mapping[str, Any], trace: Path | None
) -> dict[str, float | None]:
    """Name → value; None where the print has none: no row meets the condition, or the summary's field is null."""
    columns = read_columns(trace, columns_of(figures)) if trace is not None and trace.exists() else {}
    found: dict[str, float | None] = {}
    for name, figure in figures.items():
        value = _of_summary(summary, figure["summary"]) if "summary" in figure else _of_trace(columns, figure)
        less = found.get(figure["less"]) if figure.get("less") else 0.0
        if value is not None:
            value = None if less is None else value - less + (figure.get("add") or 0.0)
        if value is not None:
            value = float(f"{value / (figure.get('per') or 1.0):.9g}")
        found[name] = value
    return found


def columns_of(figures: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Columns of the trace that the figures need."""
    names: dict[str, None] = {}
    for figure in figures.values():
        if "trace" in figure:
            terms = [figure["trace"], figure["minus"], figure.get("weight") or ""]
            terms += [term for term, _, _ in figure["where"]]
            used = [name for term in terms for name in _NAME.findall(term) if name != "abs"]
            if figure["take"] in ("seconds", "sine") or figure.get("average_s"):
                used.append("t_s")
            names.update(dict.fromkeys(used))
    return list(names)


def read_columns(trace: Path, names: list[str]) -> dict[str, Any]:
    """These columns of a trace; the others are not kept."""
    if not names:
        return {}
    with trace.open(encoding="utf-8") as file:
        header = file.readline().strip().split(",")
        known = [name for name in names if name in header]
        rows = np.loadtxt(file, delimiter=",", usecols=[header.index(name) for name in known], ndmin=2)
    return {name: rows[:, number] for number, name in enumerate(known)}


def _of_summary(summary: Mapping[str, Any], path: str) -> float | None:
    value: Any = summary
    for key in path.split("."):
        if isinstance(value, list) and key.isdecimal() and int(key) < len(value):
            value = value[int(key)]
        elif isinstance(value, Mapping) and key in value:
            value = value[key]
        else:
            return None
    if isinstance(value, list | Mapping):
        return float(len(value))
    return float(value) if isinstance(value, int | float) else None


def _of_trace(columns: Mapping[str, Any], figure: Mapping[str, Any]) -> float | None:
    if figure["trace"] not in columns:
        return None
    values = columns[figure["trace"]]
    if figure["minus"]:
        values = values - columns[figure["minus"]]
    keep = np.isfinite(values)
    for term, sign, bound in figure["where"]:
        keep &= _COMPARE[sign](_term(columns, term), bound)
    if figure["take"] == "seconds":
        times = columns["t_s"]
        return float(f"{np.sum(keep) * (times[-1] - times[0]) / max(1, len(times) - 1):.9g}")
    if not keep.any():
        return None
    weights = columns[figure["weight"]][keep] if figure.get("weight") else np.ones(np.sum(keep))
    values = values[keep]
    if figure["take"] == "sine":
        return float(f"{_amplitude(values, columns['t_s'][keep], figure['hz']):.9g}")
    if figure.get("average_s"):
        values, weights = _averages(values, weights, columns["t_s"][keep], figure["average_s"])
    return float(f"{_reduce(values, weights, figure['take']):.9g}")


def _term(columns: Mapping[str, Any], text: str) -> Any:
    """A column, a difference of two, or abs(...) of either."""
    names = [name for name in _NAME.findall(text) if name != "abs"]
    value = columns[names[0]] if len(names) == 1 else columns[names[0]] - columns[names[1]]
    return np.abs(value) if text.startswith("abs(") else value


def _averages(values: Any, weights: Any, times: Any, span_s: float) -> tuple[Any, Any]:
    """Means over intervals of so long, and the weight of each."""
    slot = np.floor((times - times[0]) / span_s).astype(int)
    total = np.bincount(slot, weights)
    held = total > 0.0
    return np.bincount(slot, weights * values)[held] / total[held], total[held]


def _amplitude(values: Any, times: Any, hz: float) -> float:
    """Of the sine of this frequency in the values, by least squares beside their mean."""
    turns = 2.0 * np.pi * hz * (times - times[0])
    shapes = np.column_stack([np.ones_like(turns), np.sin(turns), np.cos(turns)])
    return float(np.hypot(*np.linalg.lstsq(shapes, values, rcond=None)[0][1:]))


def _percentile(values: Any, weights: Any, percent: int) -> float:
    """The value below which this share of the weight lies."""
    order = np.argsort(values)
    middle = np.cumsum(weights[order]) - 0.5 * weights[order]
    if np.all(weights == weights[0]):
        return float(np.percentile(values, percent))
    return float(np.interp(0.01 * percent * np.sum(weights), middle, values[order]))


def _reduce(values: Any, weights: Any, take: str) -> float:
    percent, _, absolute = take.removeprefix("p").partition("_")
    if percent.isdecimal():
        return _percentile(np.abs(values) if absolute else values, weights, int(percent))
    reductions: dict[str, Callable[[Any], Any]] = {
        "min": np.min,
        "max": np.max,
        "range": np.ptp,
        "mean": lambda v: np.average(v, weights=weights),
        "rms": lambda v: np.sqrt(np.average(np.square(v), weights=weights)),
        "max_abs": lambda v: np.max(np.abs(v)),
        "last": lambda v: v[-1],
    }
    return float(reductions[take](values))
