"""Plausibility of what the chain sees and does: returns a fault text, or "" while all is well.

The MCU's guard watches single blocks against fixed limits with the host dead; this watches what needs memory
and a target: no blocks, no valid temperature, too hot, too cold, power in and no warmth out, warmth without power, a
reading that does not follow the heat (heat_witness.h). A fault latches: once named it stays.

    OFF ──► WARMING ──► HOLD ──► COOLING ──► OFF        by target and reading
      any ──► DOUBT ──► back, or FAULT                  by the heat witness: power is held back meanwhile
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from thermal.models import heat_loss

from . import heat_balance_monitor
from .blocks import REASONS

OFF, WARMING, HOLD, COOLING, DOUBT, FAULT = "off", "warming", "hold", "cooling", "doubt", "fault"
NEAR_C = 5.0  # of the target: held
COLD_C = 60.0  # below this a heater that is off has cooled down
LOSS_BAND = 0.2  # of the losses, beside their own uncertainty
UNKNOWN_LAW_C = 30.0  # more slack for a law that is not the tank's

# heat_witness.h, enum witness_trip
_WITNESS = {
    1: "the reading does not follow the heat that goes in: {missing:.0f} C are missing at {temp:.0f} C (sensing chain,"
    " coil, supply, or another nozzle than the calibrated one)",
    2: "the reading rises by {surplus:.0f} C more than the heat that goes in allows, at {temp:.0f} C: does the bridge"
    " heat by itself, or did the signal jump?",
    3: "nozzle at {temp:.0f} C, more than {room:g} C above its target of {base:.0f} C",
}


@dataclass(frozen=True, slots=True)
class SuperviseParameters:
    """Limits of one heater."""

    temp_low_c: float
    temp_high_c: float  # the greatest target
    over_c: float = (
        5.0  # room above it: a PID passes its target by up to 4.2 C, predictive control by 1.0 (Control.md)
    )
    silence_s: float = 1.0  # no block at all, or no control
    invalid_s: float = 2.0  # blocks, but no valid temperature
    limit_blocks: int = 6  # consecutive estimates beyond a limit (10 ms): one alone may be a disturbance
    gain_s: float = 3.0  # under demand the nozzle must warm within this time ...
    gain_c: float = 2.0  # ... by this much
    demand_c: float = 5.0  # "under demand": this far below target ...
    demand_fraction: float = 0.5  # ... with at least this fraction of full power asked
    warming_s: float = 2.0  # with the heater off the nozzle may in this time ...
    warming_c: float = 15.0  # ... not warm by this much
    above_target_c: float = 25.0  # room above the target or the way down to it: 5 LSB of interference take 21
    unasked_c: float = 8.0  # heat beyond all commands may warm the nozzle by this much: a command may be late
    slack_c: float = 15.0  # of the heat witness: 5 LSB of interference are 12 C from peak to peak
    calibrated: bool = True  # else temperatures say nothing: only silence is a fault

    @property
    def trip_high_c(self) -> float:
        """Too hot: a target of temp_high_c must be held without that."""
        return self.temp_high_c + self.over_c


@dataclass(slots=True)
class SuperviseState:
    """Memory of the watch; times are print times."""

    fault: str = ""
    demand_s: float = math.inf  # start of the present window of unmet demand
    demand_from_c: float = math.nan
    off_s: float = math.inf  # start of the present window with the heater off
    off_from_c: float = math.nan
    unasked_s: float = math.inf  # newest block that was driven harder than any command asked for ...
    unasked_j: float = 0.0  # ... and the heat of all in a row
    limit_w: float = math.inf  # power held back while the reading is in doubt


def start(state: SuperviseState, seen: Any, time_s: float) -> None:
    """Supervision begins (or begins anew after a pause of the whole machine). `seen`: see watch()."""
    seen.last_block_s = seen.last_valid_s = time_s
    seen.beyond = 0
    state.demand_s = state.off_s = state.unasked_s = math.inf


def _limit(parameters: SuperviseParameters, temp_c: float) -> str:
    if temp_c > parameters.temp_high_c:
        return (
            f"nozzle at {temp_c:.1f} C, more than {parameters.over_c:g} C above max_temp"
            f" {parameters.temp_high_c:.1f} C"
        )
    return (
        f"the coil's signal reads {temp_c:.1f} C, below min_temp {parameters.temp_low_c:.1f} C: is the coil or its"
        " sensing lead open, the calibration another nozzle's, or the room that cold?"
    )


def _gain(
    parameters: SuperviseParameters, state: SuperviseState, time_s: float, temp_c: float, demand: bool
) -> str:
    """Power in, no warmth out."""
    if not demand:
        state.demand_s = math.inf
        return ""
    warmed = temp_c >= state.demand_from_c + parameters.gain_c
    if state.demand_s == math.inf or warmed:
        state.demand_s, state.demand_from_c = time_s, temp_c
        return ""
    if time_s - state.demand_s < parameters.gain_s:
        return ""
    return (
        f"heating too slow: {temp_c - state.demand_from_c:+.1f} C in {parameters.gain_s:.0f} s at"
        f" {temp_c:.0f} C although much power is asked; check the coil, the bridge's supply and that"
        " the nozzle is in place"
    )


def _warms_while_off(
    parameters: SuperviseParameters, state: SuperviseState, time_s: float, temp_c: float, off: bool
) -> str:
    """Warmth without power."""
    if not off:
        state.off_s = math.inf
        return ""
    if state.off_s == math.inf or time_s - state.off_s > parameters.warming_s or temp_c < state.off_from_c:
        state.off_s, state.off_from_c = time_s, temp_c
        return ""
    if temp_c - state.off_from_c < parameters.warming_c:
        return ""
    return f"nozzle warms with the heater off ({temp_c:.0f} C): is the bridge stuck on?"


def inform(
    parameters: SuperviseParameters,
    balance: heat_balance_monitor.HeatBalanceParameters,
    seen: heat_balance_monitor.HeatBalanceState,
    inputs: Any,
    taken_w: float,
    exact: bool,
) -> None:
    """What the heat witness may assume. `inputs`: C's struct witness_inputs; `taken_w`: max of what filament and fan
    take."""
    loss, temp_c = balance.loss, seen.temp_c
    over_k = max(20.0, temp_c - loss.ambient_c)
    doubt_w = loss.link_w_k * seen.second_doubt_c
    out_w = loss.skin_out_w(temp_c, seen.second_c)
    band = LOSS_BAND + balance.loss_uncertainty
    inputs.loss_low_w_k = max(0.0, (out_w - doubt_w) * (1.0 - band)) / over_k
    inputs.loss_high_w_k = max(0.0, (out_w + doubt_w) * (1.0 + band)) / over_k
    inputs.taken_w = taken_w
    inputs.slack_c = parameters.slack_c if exact else parameters.slack_c + UNKNOWN_LAW_C
    inputs.is_on = parameters.calibrated


def name_state(state: SuperviseState, witness: Any, temp_c: float, target_c: float) -> str:
    """Where a nozzle is; `witness`: C's struct witness_state."""
    if state.fault:
        return FAULT
    if not math.isnan(witness.beyond_s):
        return DOUBT
    if target_c <= 0.0:
        return COOLING if temp_c > COLD_C else OFF
    if abs(temp_c - target_c) <= NEAR_C:
        return HOLD
    return WARMING if temp_c < target_c else COOLING


def _doubt(
    parameters: SuperviseParameters,
    state: SuperviseState,
    seen: Any,
    witness: Any,
    temp_c: float,
    loss: heat_loss.LossLaw,
) -> str:
    """A doubt holds the power back; one that stays, or is gross, is a fault."""
    state.limit_w = 0.0 if math.isnan(temp_c) else heat_loss.loss_w(loss, temp_c)
    if not witness.is_tripped or seen.beyond:  # beyond a limit: that says more
        return ""
    return _WITNESS[witness.is_tripped].format(
        missing=witness.missing_c,
        surplus=witness.surplus_c,
        temp=temp_c,
        room=parameters.above_target_c,
        base=witness.base_c,
    )


def watch_reading(
    parameters: SuperviseParameters,
    state: SuperviseState,
    seen: Any,
    witness: Any,
    temp_c: float,
    target_c: float,
    loss: heat_loss.LossLaw,
) -> str:
    """To be called before watch(), with the same `seen`. `witness`: C's struct witness_state."""
    witness.inputs.target_c = target_c
    if math.isnan(witness.beyond_s) and not witness.is_tripped:
        state.limit_w = math.inf
    elif not state.fault:
        state.fault = _doubt(parameters, state, seen, witness, temp_c, loss)
    return state.fault


def watch_drive(
    parameters: SuperviseParameters, state: SuperviseState, time_s: float, over_w: float, heat_j_k: float
) -> None:
    """For each reading, before watch(). `over_w`: its drive less the strongest command; NaN: not known."""
    if not over_w > 0.0:
        state.unasked_s = math.inf
        return
    if state.unasked_s == math.inf:
        state.unasked_j = 0.0
    else:
        state.unasked_j += over_w * (time_s - state.unasked_s)
    state.unasked_s = time_s
    if state.unasked_j > parameters.unasked_c * heat_j_k and not state.fault:
        state.fault = (
            f"the bridge is driven with {over_w:.0f} W more than any command asks for: what the host decides does not"
            " reach it"
        )


def watch_host(parameters: SuperviseParameters, state: SuperviseState, late_s: float) -> None:
    """To be called before watch(): a host that slept is not to blame the board for its silence."""
    if late_s > parameters.silence_s and not state.fault:
        state.fault = (
            f"no control for {late_s:.1f} s: the computer was too busy, or the host program was stopped"
        )


def watch(
    parameters: SuperviseParameters,
    state: SuperviseState,
    seen: Any,
    time_s: float,
    temp_c: float,
    target_c: float,
    power_fraction: float,
) -> str:
    """To be called regularly.

    `seen`: what the blocks have shown, C's struct chain_watch. `temp_c` newest valid temperature,
    `power_fraction` requested / full power.
    """
    if state.fault:
        return state.fault
    if seen.is_tripped:
        state.fault = _limit(parameters, seen.tripped_c)
    elif time_s - seen.last_block_s > parameters.silence_s:
        state.fault = f"no samples from the induction unit for {time_s - seen.last_block_s:.1f} s"
    elif time_s - seen.last_valid_s > parameters.invalid_s:
        why = REASONS[seen.fault] or "no usable block"
        state.fault = f"no valid nozzle temperature for {time_s - seen.last_valid_s:.1f} s ({why})"
    elif parameters.calibrated and not math.isnan(temp_c):
        demand = target_c - temp_c > parameters.demand_c and power_fraction >= parameters.demand_fraction
        state.fault = _gain(parameters, state, time_s, temp_c, demand)
        off = target_c <= 0.0 and power_fraction <= 0.0
        state.fault = state.fault or _warms_while_off(parameters, state, time_s, temp_c, off)
    return state.fault
