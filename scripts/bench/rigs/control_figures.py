"""Figures of a heater under one law: a climb, a hold, flow and none, a step; degC and s, true temperatures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BAND_C = 3.0


@dataclass(frozen=True, slots=True)
class Result:
    """`settle_s`, `step_s`: last time outside +-3 degC; `optimal_s`, `step_min_s`: full power from the command on."""

    controller: str
    plant: str
    settle_s: float
    optimal_s: float
    overshoot_c: float
    hold_c: float  # worst error over the end of the hold
    ripple_c: float  # peak to peak over it
    flow_deviation_c: float
    flow_steady_c: float  # |mean error| over the end of the flow
    step_s: float
    step_min_s: float

    @property
    def settle_ratio(self) -> float:
        return self.settle_s / self.optimal_s

    @property
    def step_over_s(self) -> float:
        return self.step_s - self.step_min_s


@dataclass(frozen=True, slots=True)
class Programme:
    """Times of the parts, and the record of a run."""

    target_c: float
    heat_s: float
    held_s: float
    flow_s: float  # when the flow ends
    end_s: float
    watched_s: tuple[float, float]  # how long the end of the hold is, and that of the flow
    t_s: np.ndarray
    temp_c: np.ndarray

    def errors(self, start_s: float, end_s: float) -> np.ndarray:
        return self.temp_c[(self.t_s > start_s) & (self.t_s <= end_s)] - self.target_c

    def result(
        self, controller: str, plant: str, optimal_s: float, step_s: float, step_min_s: float
    ) -> Result:
        held = self.errors(self.held_s - self.watched_s[0], self.held_s)
        return Result(
            controller,
            plant,
            settled_s(self.t_s, self.temp_c, self.heat_s, self.held_s, self.target_c),
            optimal_s,
            max(0.0, float(self.errors(self.heat_s, self.held_s).max())),
            float(np.abs(held).max()),
            float(np.ptp(held)),
            float(np.abs(self.errors(self.held_s, self.end_s)).max()),
            float(abs(self.errors(self.flow_s - self.watched_s[1], self.flow_s).mean())),
            step_s,
            step_min_s,
        )


def settled_s(t_s: np.ndarray, temp_c: np.ndarray, start_s: float, end_s: float, target_c: float) -> float:
    """Last time outside the band, from start_s."""
    select = (t_s > start_s) & (t_s <= end_s)
    outside = t_s[select][np.abs(temp_c[select] - target_c) > BAND_C]
    return float(outside[-1] - start_s) if len(outside) else 0.0
