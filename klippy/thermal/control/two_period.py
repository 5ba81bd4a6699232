"""`control: two_period`: the two-period law of Liu 2019 (section 4, Table 2), as published.

    flying   the temperature rises: less and less drive as the target comes near, none from 3 degC below it on
    falling  the temperature falls: 210..225 of 255, whatever the distance, above the target as well

The paper does not say how to distinguish rising from falling. Here the period changes when the temperature has turned
by `turn_c` against it.

Limits of the law. It has no integral and no knowledge of the heater: it ends in a cycle whose middle and width are the
heater's lag times its power, not the target's doing. "Falling" drives at 82 % and more even above the target, so a
strong heater with a lag (70 W on a hotend) cycles far above it. Alone it is unsafe; here it stands under the guards
every heater has (max_temp on the MCU, verify_heater), and one of its own, not from the paper: more than `cutoff_c`
above the target there is no drive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from thermal.records import require

from .control_api import ControlInput, ControlOutput, Law

# Table 2. (minimum T_e in degC, a of 255), T_e = target minus temperature; the last row has no lower end.
FLYING: tuple[tuple[float, int], ...] = (
    (20.0, 255),
    (10.0, 240),
    (7.0, 200),
    (5.0, 160),
    (3.0, 80),
    (-math.inf, 0),
)
FALLING: tuple[tuple[float, int], ...] = ((5.0, 225), (2.0, 210), (-math.inf, 220))
TABLE_FULL = 255.0


@dataclass(frozen=True, slots=True)
class TwoPeriodParameters:
    """`output_high` is what 255 in the table means. Raises ParameterError on impossible values."""

    output_high: float
    turn_c: float = 0.3
    cutoff_c: float = 15.0

    def __post_init__(self) -> None:
        require(0.0 < self.output_high < math.inf, "two-period: the output must be above 0")
        require(0.0 < self.turn_c < math.inf, "two-period: the turn must be above 0")
        require(0.0 < self.cutoff_c < math.inf, "two-period: the cutoff must be above 0")


@dataclass(frozen=True, slots=True)
class TwoPeriodState:
    """Period, and the farthest the temperature has been in its direction."""

    flying: bool = True
    extreme_c: float = math.nan


def table_value(flying: bool, below_c: float) -> int:
    """Drive 0..255 of Table 2, `below_c` below the target."""
    rows = FLYING if flying else FALLING
    return next(value for from_c, value in rows if below_c >= from_c)


def _period(parameters: TwoPeriodParameters, state: TwoPeriodState, temp_c: float) -> TwoPeriodState:
    if math.isnan(state.extreme_c):
        return replace(state, extreme_c=temp_c)
    ahead_c = temp_c - state.extreme_c if state.flying else state.extreme_c - temp_c
    if ahead_c >= 0.0:
        return replace(state, extreme_c=temp_c)
    if -ahead_c >= parameters.turn_c:
        return TwoPeriodState(not state.flying, temp_c)
    return state


def two_period_step(
    parameters: TwoPeriodParameters, state: TwoPeriodState, inputs: ControlInput, time_s: float
) -> tuple[ControlOutput, TwoPeriodState]:
    """One decision; `time_s` does not matter to this law."""
    if math.isnan(inputs.measured_c):
        return ControlOutput(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), state
    state = _period(parameters, state, inputs.measured_c)
    below_c = inputs.reference_c - inputs.measured_c
    wanted = parameters.output_high * table_value(state.flying, below_c) / TABLE_FULL
    allowed = wanted if below_c >= -parameters.cutoff_c else 0.0
    value = max(0.0, min(parameters.output_high, inputs.limit, allowed))
    return ControlOutput(value, wanted, wanted, 0.0, 0.0, 0.0), state


def two_period_follow(
    parameters: TwoPeriodParameters, state: TwoPeriodState, inputs: ControlInput, output: float
) -> TwoPeriodState:
    """A table has nothing to be re-based; the period is found anew."""
    return TwoPeriodState()


TWO_PERIOD: Law[TwoPeriodParameters, TwoPeriodState] = Law(
    "two_period", two_period_step, TwoPeriodState(), two_period_follow
)
