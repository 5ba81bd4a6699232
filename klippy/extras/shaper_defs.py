"""Shapers under the names that plugins use."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from vibration import fit_shaper, shapers

DEFAULT_DAMPING_RATIO = fit_shaper.DAMPING_RATIO
AUTOTUNE_SHAPERS = list(fit_shaper.AUTOTUNED)
Impulses = tuple[list[float], list[float]]


class InputShaperCfg(NamedTuple):
    """A type; `init_func(Hz, damping ratio)` gives amplitudes and times (s)."""

    name: str
    init_func: Callable[[float, float], Impulses]
    min_freq: float
    max_damping_ratio: float


def _impulses(name: str, shaper_freq: float, damping_ratio: float) -> Impulses:
    return shapers.parse(name).pulses(shaper_freq, damping_ratio)


def get_none_shaper() -> Impulses:
    """No shaping."""
    return [], []


INPUT_SHAPERS = [
    InputShaperCfg(kind.name, partial(_impulses, kind.name), kind.min_hz, kind.max_damping_ratio)
    for kind in shapers.SHAPERS.values()
]
