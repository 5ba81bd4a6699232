"""What the melt takes from an induction nozzle, from held steps at several flows. Offline code: numpy, scipy.

The nozzle's own numbers are known by then (fit_load.py), and its temperature is always measured. Heat that is put in
and is neither stored in the metal nor lost went into the filament:

    r(t) = integral of (P - loss(T, T2)) dt - H(T)        its slope over a step is the heat of the melt, W
    dT2/dt = (link (T - T2) - second (T2 - Ta))/C2        second mass, from the measured T since the cold start
    slope  = h(f) (T - Tin) + d loss(T, T2)               h(f) = c f (1 - exp(-UA/(c f)))

Slow steps determine c, the heat of a volume of filament; fast ones UA, the exchange in the bore. Two temperatures give
Tin, at which the filament enters; steps without flow give d, the change of the losses from those found before.
A wrong scale of the power changes c and UA alike, and how hot the melt leaves only depends on UA/(c f).
One step is kept from the fit; a fit that does not predict its heat is refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from scipy import optimize

from thermal.models.heat_loss import STEFAN_BOLTZMANN, ZERO_CELSIUS_K, HeatCapacity
from thermal.models.melt_exchange import MeltExchange
from thermal.sensing.heat_balance_monitor import TwoNodeLoss

from .step_test import MELT, MELT_PROOF, Row

SETTLE_S = 1.0  # of a step: the temperature arrives, the flow of the step before runs out ...
SETTLE_SHARE = 0.6  # ... of the hold: the second mass too
MIN_S = 2.0  # a slope over less is noise
STEADY_SHARE = 0.05  # flows nearer than this are one
HELD_C = 2.0  # a step is at its temperature within this: far above noise, and the fall to it is left out
NOISE_W = 0.005  # of a slope over some seconds: 0.1 degC a reading, 0.45 J/K
SHAPE_SHARE = 0.005  # of the heat of the melt: no filament is a constant c
LOSS_SHARE = 0.02  # 1 sigma of d before the run
INLET_C = 15.0  # 1 sigma of the filament's temperature about the room's before the run
MIN_HEAT = 0.25  # of what any filament takes: less is none
LIMIT_W, LIMIT_SHARE = 0.05, 0.03  # the kept step's heat is predicted within this, or this share of it
DOUBT = 0.06  # relative 1 sigma of UA/c beyond which the run determines nothing
RANGES = {"c": (0.5, 6.0), "ua": (0.003, 0.3)}  # MJ/m3K, W/K: no filament, no nozzle beyond
START = MeltExchange()


class MeltFitError(ValueError):
    """The steps do not determine the exchange; the text is for people."""


@dataclass(frozen=True, slots=True)
class Held:
    """One step: means, and the heat that went neither into metal nor air."""

    stage: str
    temp_c: float
    flow_mm3_s: float
    heat_w: float
    loss_w: float
    lasts_s: float


@dataclass(frozen=True, slots=True)
class MeltFit:
    """The exchange, 1 sigma of its numbers, and the steps with what the exchange says of them."""

    exchange: MeltExchange
    sigma: dict[str, float]  # relative for ua, c and ratio (UA/c); degC for inlet; share for loss
    held: tuple[Held, ...]
    expected_w: tuple[float, ...]

    def outlet_doubt_c(self, temp_c: float, flow_mm3_s: float) -> float:
        """1 sigma of the temperature at which melt leaves, from UA/c and inlet."""
        exchange = self.exchange
        number = exchange.ua_w_k / (1e-3 * exchange.heat_mj_m3k * flow_mm3_s)
        by_ratio = (temp_c - exchange.inlet_c) * number * math.exp(-number) * self.sigma["ratio"]
        return math.hypot(by_ratio, math.exp(-number) * self.sigma["inlet"])


def _second_c(time_s: Any, temp_c: Any, loss: TwoNodeLoss) -> Any:
    """Temperature of the second mass beside the measured one, from the cold start."""
    out = np.empty_like(temp_c)
    second_c = temp_c[0]
    total = loss.link_w_k + loss.second_w_k
    decays = np.exp(-np.diff(time_s, prepend=time_s[0]) * total / loss.second_j_k)
    rest = (loss.link_w_k * temp_c + loss.second_w_k * loss.ambient_c) / total
    for i, (decay, rest_c) in enumerate(zip(decays.tolist(), rest.tolist(), strict=True)):
        second_c = rest_c + (second_c - rest_c) * decay
        out[i] = second_c
    return out


def held_steps(rows: Sequence[Row], heat: HeatCapacity, loss: TwoNodeLoss) -> list[Held]:
    """The heat of each further step. `rows`: all of the run (fit_load.thin). Raises MeltFitError."""
    time_s, temp_c, output, flow = (np.array([r[i] for r in rows]) for i in (0, 1, 2, 4))
    second_c = _second_c(time_s, temp_c, loss)
    hot_k4 = (temp_c + ZERO_CELSIUS_K) ** 4 - (loss.ambient_c + ZERO_CELSIUS_K) ** 4
    lost_w = loss.link_w_k * (temp_c - second_c) + loss.skin_w_k * (temp_c - loss.ambient_c)
    lost_w = lost_w + STEFAN_BOLTZMANN * loss.radiation_m2 * hot_k4
    over_c = temp_c - 25.0
    stored_j = heat.at_25c_j_k * over_c * (1.0 + 0.5 * heat.slope_per_k * over_c)
    middle_w = 0.5 * (lost_w + np.concatenate((lost_w[:1], lost_w[:-1])))
    left_j = np.cumsum((output - middle_w) * np.diff(time_s, prepend=time_s[0])) - stored_j
    steps, missed, begin = [], "", 0
    for stage, group in groupby(rows, key=lambda row: row.stage):
        end = begin + sum(1 for _ in group)
        if stage == "hold" or stage.startswith(MELT):
            part = _steady(stage, (time_s, temp_c, flow), begin, end)
            if part is None:
                missed, begin = missed or stage, end
                continue
            slope_w = float(np.polyfit(time_s[part] - time_s[begin], left_j[part], 1)[0])
            means = (float(np.mean(x[part])) for x in (temp_c, flow, lost_w))
            mean_c, mean_flow, mean_loss = means
            lasts_s = float(time_s[part][-1] - time_s[part][0])
            steps.append(Held(stage, mean_c, mean_flow, slope_w, mean_loss, lasts_s))
        begin = end
    if missed:
        _check_filament(steps, loss.ambient_c)
        raise MeltFitError(
            f"step '{missed}' has no {MIN_S:g} s at one temperature and flow: did the extruder stop?"
        )
    return steps


def _steady(stage: str, columns: tuple[Any, Any, Any], begin: int, end: int) -> slice | None:
    """Rows of a step from where it is settled on, at one temperature and flow; None: too few."""
    time_s, temp_c, flow = columns
    settle_s = SETTLE_S if stage.startswith(MELT) else SETTLE_SHARE * (time_s[end - 1] - time_s[begin])
    settled = np.arange(begin, end)[time_s[begin:end] >= time_s[begin] + settle_s]
    if len(settled):
        middle = float(np.median(flow[settled]))
        settled = settled[np.abs(flow[settled] - middle) <= STEADY_SHARE * max(middle, 1e-3)]
        last = settled[time_s[settled] >= time_s[settled[-1]] - MIN_S]
        settled = settled[np.abs(temp_c[settled] - np.median(temp_c[last])) <= HELD_C]
    if len(settled) < 20 or time_s[settled[-1]] - time_s[settled[0]] < MIN_S:
        return None
    return slice(int(settled[0]), int(settled[-1]) + 1)


def _exchange(x: Any) -> MeltExchange:
    return MeltExchange(ua_w_k=math.exp(x[1]), heat_mj_m3k=math.exp(x[0]), inlet_c=float(x[2]))


def expected_w(exchange: MeltExchange, loss_share: float, held: Held) -> float:
    """Heat of the melt, and of the losses not known before."""
    melt_w = exchange.heat_w_k(held.flow_mm3_s) * (held.temp_c - exchange.inlet_c)
    return melt_w + loss_share * held.loss_w


def fit_held(held: Sequence[Held], ambient_c: float) -> MeltFit:
    """The exchange from all steps but the proof. Raises MeltFitError."""
    fitted = [h for h in held if h.stage != MELT_PROOF]
    _check_filament(fitted, ambient_c)
    weight = [1.0 / math.hypot(NOISE_W, SHAPE_SHARE * h.heat_w) for h in fitted]

    def residual(x: Any) -> Any:
        exchange = _exchange(x)
        errors = [w * (h.heat_w - expected_w(exchange, x[3], h)) for w, h in zip(weight, fitted, strict=True)]
        return np.array([*errors, (x[2] - ambient_c) / INLET_C, x[3] / LOSS_SHARE])

    start = [math.log(START.heat_mj_m3k), math.log(START.ua_w_k), ambient_c, 0.0]
    found = optimize.least_squares(residual, start, x_scale=[0.1, 0.1, 5.0, 0.01], max_nfev=200)
    free = max(1, len(found.fun) - len(start))
    scale = max(1.0, float(np.sum(found.fun**2)) / free)
    covariance = scale * np.linalg.pinv(found.jac.T @ found.jac)
    sigma = {name: math.sqrt(covariance[i, i]) for i, name in enumerate(("c", "ua", "inlet", "loss"))}
    ratio2 = covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1]
    sigma["ratio"] = math.sqrt(max(0.0, ratio2))
    exchange = _exchange(found.x)
    fit = MeltFit(exchange, sigma, tuple(held), tuple(expected_w(exchange, found.x[3], h) for h in held))
    _judge(fit)
    return fit


def _check_filament(held: Sequence[Held], ambient_c: float) -> None:
    """Is there any filament? A quarter of the reference exchange is a wider band than filaments and nozzles make."""
    still = [h.heat_w for h in held if h.flow_mm3_s <= 0.0]
    moving = [h for h in held if h.flow_mm3_s > 0.0]
    if len({round(h.flow_mm3_s, 2) for h in moving}) < 2 or not still:
        raise MeltFitError("two flows at least are needed, and a step without: the extruder did not move")
    fast = max(moving, key=lambda h: h.flow_mm3_s)
    taken_w = fast.heat_w - sum(still) / len(still)
    usual_w = START.heat_w_k(fast.flow_mm3_s) * (fast.temp_c - ambient_c)
    if taken_w < MIN_HEAT * usual_w:
        raise MeltFitError(
            f"at {fast.flow_mm3_s:.1f} mm3/s the filament took {taken_w:.2f} W, and {usual_w:.1f} W are usual: no"
            " filament is loaded, it slips, or the nozzle is clogged"
        )


def _judge(fit: MeltFit) -> None:
    for h, expected in zip(fit.held, fit.expected_w, strict=True):
        limit_w = max(LIMIT_W, LIMIT_SHARE * abs(h.heat_w))
        if abs(h.heat_w - expected) > limit_w:
            which = "the step it was not shown" if h.stage == MELT_PROOF else f"step '{h.stage}'"
            raise MeltFitError(
                f"the exchange misses {which} ({h.flow_mm3_s:.1f} mm3/s at {h.temp_c:.0f} C) by"
                f" {h.heat_w - expected:+.2f} W of {h.heat_w:.2f} W: the filament slipped at that flow, a fan or a"
                " draught cooled the nozzle, or the nozzle is not as its model"
            )
    if fit.sigma["ratio"] > DOUBT:
        raise MeltFitError(
            f"the flows are too slow to determine the exchange ({100.0 * fit.sigma['ratio']:.0f} % in doubt): give a"
            " higher FLOW"
        )
    for name, value in (("c", fit.exchange.heat_mj_m3k), ("ua", fit.exchange.ua_w_k)):
        low, high = RANGES[name]
        if not low <= value <= high:
            raise MeltFitError(f"the filament's {name} comes out at {value:.3g}, outside {low:g} to {high:g}")


def options(fit: MeltFit) -> dict[str, float]:
    """The exchange in words of printer.cfg."""
    exchange = fit.exchange
    return {
        "melt_exchange": exchange.ua_w_k,
        "melt_heat": exchange.heat_mj_m3k,
        "melt_inlet_temp": exchange.inlet_c,
    }


def report(fit: MeltFit) -> list[str]:
    exchange, sigma = fit.exchange, fit.sigma
    lines = [
        f"  melt exchange, W/K         {exchange.ua_w_k:9.4g} +- {sigma['ua'] * exchange.ua_w_k:.2g}",
        f"  heat of filament, MJ/m3K   {exchange.heat_mj_m3k:9.4g} +- {sigma['c'] * exchange.heat_mj_m3k:.2g}",
        f"  filament enters at, C      {exchange.inlet_c:9.4g} +- {sigma['inlet']:.2g}",
    ]
    for h, expected in zip(fit.held, fit.expected_w, strict=True):
        if h.flow_mm3_s > 0.0:
            leaves_c = exchange.inlet_c + (h.temp_c - exchange.inlet_c) * exchange.share(h.flow_mm3_s)
            lines.append(
                f"  {h.flow_mm3_s:5.1f} mm3/s at {h.temp_c:.0f} C: {h.heat_w:.2f} W, model {expected:.2f} W; leaves at"
                f" {leaves_c:.0f} +- {fit.outlet_doubt_c(h.temp_c, h.flow_mm3_s):.1f} C"
                + (" (kept from the fit)" if h.stage == MELT_PROOF else "")
            )
    return lines
