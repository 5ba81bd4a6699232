"""The C of bridge.h part by part: the actuator, and the timeline of commands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import chelper
from thermal.control.actuator import ActuatorParameters
from thermal.control.timeline import Bridge, commands_of
from thermal.records import PhaseCommand, Planned

FFI, LIB = chelper.get_ffi()


def planned(plan: Sequence[Planned]) -> Any:
    return FFI.new("struct model_planned[]", list(plan))


def actuator_state() -> Any:
    state = FFI.new("struct actuator_state *")
    LIB.actuator_reset(state)
    return state


def actuate(
    parameters: ActuatorParameters, state: Any, power_w: float, time_s: float, is_on: bool, idle: bool = False
) -> list[PhaseCommand]:
    out = FFI.new("struct phase_command[2]")
    packed = FFI.new("struct actuator_params *", parameters.packed())
    return commands_of(
        out,
        LIB.actuator_act(
            packed, state, power_w, time_s, is_on, LIB.SENSE_IDLE if idle else LIB.SENSE_WATCH, out
        ),
    )


def ahead(
    parameters: ActuatorParameters, first: PhaseCommand, horizon: Sequence[Planned]
) -> list[PhaseCommand]:
    out = FFI.new("struct phase_command[]", 1 + len(horizon))
    out[0] = first
    packed = FFI.new("struct actuator_params *", parameters.packed())
    count = LIB.actuator_ahead(packed, planned(horizon), len(horizon), out)
    return commands_of(out, 1 + count)[1:]


def differs(bridge: Bridge, plan: Sequence[Planned], by_w: float) -> bool:
    line = FFI.addressof(bridge.raw, "line")
    return bool(LIB.timeline_differs(line, planned(plan), len(plan), by_w))
