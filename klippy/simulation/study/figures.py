"""Figures of one print, from its summary and its trace."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

_COMPARE = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}


def collect(
    figures: Mapping[str, Mapping[str, Any]], summary: Mapping[str, Any], trace: Path | None
) -> dict[str, float | None]:
    """Name → value; None where the print has none: no row meets the condition, or the summary's field is null."""
    columns = read_columns(trace, columns_of(figures)) if trace is not None and trace.exists() else {}
    return {
        name: _of_summary(summary, figure["summary"]) if "summary" in figure else _of_trace(columns, figure)
        for name, figure in figures.items()
    }


def columns_of(figures: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Columns of the trace that the figures need."""
    names: dict[str, None] = {}
    for figure in figures.values():
        if "trace" in figure:
            used = [figure["trace"], figure["minus"], *(name for name, _, _ in figure["where"])]
            names.update(dict.fromkeys(name for name in used if name))
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
    keep = np.ones(len(values), dtype=bool)
    for name, sign, bound in figure["where"]:
        keep &= _COMPARE[sign](columns[name], bound)
    values = values[keep]
    if not len(values):
        return None
    return float(f"{_reduce(values, figure['take']):.9g}")


def _reduce(values: Any, take: str) -> float:
    if take.startswith("p") and take[1:].isdecimal():
        return float(np.percentile(values, int(take[1:])))
    reductions: dict[str, Callable[[Any], Any]] = {
        "min": np.min,
        "max": np.max,
        "mean": np.mean,
        "rms": lambda v: np.sqrt(np.mean(np.square(v))),
        "max_abs": lambda v: np.max(np.abs(v)),
        "last": lambda v: v[-1],
    }
    return float(reductions[take](values))
