"""Does the temperature of the coil agree with the heat that went in? A heat balance over half a minute, in degC.

Reference plant's two nodes, T measured, T2 followed from it:

    C dT/dt  = P - k01 (T - T2) - g0 (T - Ta) - sigma eA (T^4 - Ta^4)
    C2 dT2/dt = k01 (T - T2) - g1 (T2 - Ta)

What is left over of that balance, averaged over `window_s` and divided by what a degree changes of it, is the error
the reading would have to have: `drift_c` (reading minus temperature of the heat balance). It only says something while
no melt and
no fan take heat away (`quiet`), and is as good as the losses are known: calibration measures them.

A heat-up shows the nozzle's capacity the same way: heat that went in over degrees that came out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from thermal.models import heat_loss


@dataclass(frozen=True, slots=True)
class TwoNodeLoss:
    """Paths of heat out of the nozzle (reference plant), all scaled together by calibration."""

    skin_w_k: float = 7.16e-3
    link_w_k: float = 41.1e-3
    second_j_k: float = 0.572
    second_w_k: float = 16.0e-3
    radiation_m2: float = 1.0e-4
    ambient_c: float = 25.0

    def skin_out_w(self, temp_c: float, second_c: float) -> float:
        """Heat leaving the skin."""
        hot_k, ambient_k = temp_c + heat_loss.ZERO_CELSIUS_K, self.ambient_c + heat_loss.ZERO_CELSIUS_K
        return (
            self.link_w_k * (temp_c - second_c)
            + self.skin_w_k * (temp_c - self.ambient_c)
            + heat_loss.STEFAN_BOLTZMANN * self.radiation_m2 * (hot_k**4 - ambient_k**4)
        )

    def second_rate(self, temp_c: float, second_c: float) -> float:
        """dT2/dt, K/s."""
        into_w = self.link_w_k * (temp_c - second_c) - self.second_w_k * (second_c - self.ambient_c)
        return into_w / self.second_j_k

    def slope_w_k(self, temp_c: float) -> float:
        """What a degree of T changes of the static loss."""
        series = self.link_w_k * self.second_w_k / (self.link_w_k + self.second_w_k)
        hot_k = temp_c + heat_loss.ZERO_CELSIUS_K
        return series + self.skin_w_k + 4.0 * heat_loss.STEFAN_BOLTZMANN * self.radiation_m2 * hot_k**3


def scaled(factor: float, ambient_c: float, second_factor: float = 1.0) -> TwoNodeLoss:
    """The reference paths, all times `factor`, and the second mass times `second_factor`."""
    base = TwoNodeLoss()
    return TwoNodeLoss(
        base.skin_w_k * factor,
        base.link_w_k * factor,
        base.second_j_k * second_factor,
        base.second_w_k * factor,
        base.radiation_m2 * factor,
        ambient_c,
    )


@dataclass(frozen=True, slots=True)
class HeatBalanceParameters:
    """Model and its uncertainty."""

    heat: heat_loss.HeatCapacity
    loss: TwoNodeLoss
    loss_uncertainty: float = 0.25  # relative, 1 sigma twice over: what an uncalibrated nozzle may differ
    limit_c: float = 8.0  # drift beyond this plus the uncertainty is reported
    window_s: float = 12.0  # time constant of the average; the second mass settles with 10 s
    ready_s: float = 30.0  # quiet for so long before anything is said
    drift_max_c: float = 60.0  # 0.4 % of C1: no capacitor drifts more, another steel in the coil does
    run_c: float = 60.0  # a heat-up by this much shows the capacity
    run_w: float = 25.0  # mean heat over it, so that losses are a correction
    doubt_max_c: float = 2.0  # of the second mass, unknown at a start: with more only gross drift is reported
    capacity_band: float = 0.35  # capacity off by more: not the nozzle this was set up for


@dataclass(slots=True)
class HeatBalanceState:
    """Memory; times are print times."""

    time_s: float = math.nan
    temp_c: float = math.nan
    second_c: float = math.nan
    second_doubt_c: float = 0.0  # how wrong that may be; at a start it is between ambient and skin
    quiet_s: float = 0.0  # for so long nothing else took heat
    left_w: float = 0.0  # averaged remainder of the balance
    doubt_w: float = 0.0  # averaged likewise: what of it the second mass may be to blame for
    drift_c: float | None = None  # reading minus heat balance; None: nothing can be said now
    run_start_c: float = math.nan  # heat-up under way
    run_j: float = 0.0
    run_s: float = 0.0
    capacity_ratio: float | None = None  # measured over expected, newest heat-up


def _run(
    parameters: HeatBalanceParameters, state: HeatBalanceState, dt_s: float, temp_c: float, net_w: float
) -> None:
    """Record a heat-up; ends when the heat ends or enough degrees are there."""
    if net_w < parameters.run_w:
        state.run_start_c = math.nan
        return
    if math.isnan(state.run_start_c):
        state.run_start_c, state.run_j, state.run_s = temp_c, 0.0, 0.0
        return
    state.run_j += net_w * dt_s
    state.run_s += dt_s
    rise_c = temp_c - state.run_start_c
    if rise_c < parameters.run_c:
        # twice the heat that should do: the nozzle is far too heavy, or heat is not going in
        expected_j = parameters.run_c * parameters.heat.at(state.run_start_c)
        if state.run_j > 3.0 * expected_j:
            state.capacity_ratio = min(10.0, state.run_j / max(rise_c, 1.0) / parameters.heat.at(temp_c))
            state.run_start_c = math.nan
        return
    expected = parameters.heat.at(0.5 * (temp_c + state.run_start_c))
    state.capacity_ratio = state.run_j / rise_c / expected
    state.run_start_c = math.nan


def observe(
    parameters: HeatBalanceParameters,
    state: HeatBalanceState,
    time_s: float,
    temp_c: float,
    energy_j: float,
    quiet: bool,
) -> None:
    """A valid temperature at `time_s`, the heat put in since the one before (NaN: not known), and whether nothing else
    takes heat."""
    loss = parameters.loss
    dt_s = time_s - state.time_s
    if not 0.0 < dt_s < 2.0 or math.isnan(energy_j):
        if math.isnan(state.second_c):
            state.second_c = 0.5 * (temp_c + loss.ambient_c)
            state.second_doubt_c = abs(temp_c - state.second_c)
        state.time_s, state.temp_c, state.run_start_c = time_s, temp_c, math.nan
        return
    mid_c = 0.5 * (temp_c + state.temp_c)
    out_w = loss.skin_out_w(mid_c, state.second_c)
    stored_w = parameters.heat.at(mid_c) * (temp_c - state.temp_c) / dt_s
    net_w = energy_j / dt_s - out_w
    _run(parameters, state, dt_s, temp_c, net_w)
    state.second_c += dt_s * loss.second_rate(mid_c, state.second_c)
    state.second_doubt_c *= math.exp(-dt_s * (loss.link_w_k + loss.second_w_k) / loss.second_j_k)
    state.time_s, state.temp_c = time_s, temp_c
    # A fast change would judge the capacity, not the losses.
    still = quiet and abs(temp_c - mid_c) < 5.0 * dt_s
    state.quiet_s = state.quiet_s + dt_s if still else 0.0
    if not still:
        state.drift_c = None
        state.left_w = state.doubt_w = 0.0
        return
    share = dt_s / max(min(state.quiet_s, parameters.window_s), dt_s)
    state.left_w += (net_w - stored_w - state.left_w) * share
    state.doubt_w += (loss.link_w_k * state.second_doubt_c - state.doubt_w) * share
    slope_w_k = loss.slope_w_k(temp_c)
    drift_c, doubt_c = -state.left_w / slope_w_k, state.doubt_w / slope_w_k
    sure = doubt_c <= parameters.doubt_max_c or abs(drift_c) - doubt_c > parameters.drift_max_c
    state.drift_c = drift_c if sure and state.quiet_s >= parameters.ready_s else None


def uncertainty_c(parameters: HeatBalanceParameters, temp_c: float) -> float:
    """What the losses' uncertainty is worth in degC."""
    rise = abs(temp_c - parameters.loss.ambient_c)
    return parameters.loss_uncertainty * rise + 3.0  # 3: ambient not known better


def warning(parameters: HeatBalanceParameters, state: HeatBalanceState) -> str:
    """Text for people, "" while the balance holds."""
    ratio = state.capacity_ratio
    if ratio is not None and abs(ratio - 1.0) > parameters.capacity_band:
        how = "heavier or worse coupled" if ratio > 1.0 else "lighter or better coupled"
        return (
            f"wrong nozzle? its heat capacity measures {ratio:.2f} times the one set up, that is {how};"
            " run INDUCTION_CALIBRATE for this nozzle"
        )
    drift_c = state.drift_c
    if drift_c is None:
        return ""
    if abs(drift_c) <= parameters.limit_c + uncertainty_c(parameters, state.temp_c) - 3.0:
        return ""
    if abs(drift_c) > parameters.drift_max_c:
        return (
            f"wrong nozzle? the thermometer reads {drift_c:+.0f} C off (heat balance at {state.temp_c:.0f} C), more"
            " than any drift: another material or shape than the calibrated one; run INDUCTION_CALIBRATE for it"
        )
    return (
        f"the thermometer seems to have drifted by {drift_c:+.0f} C (heat balance at {state.temp_c:.0f} C);"
        " check with a reference and run INDUCTION_ZERO TEMP=..."
    )
