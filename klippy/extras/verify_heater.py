"""[verify_heater NAME]: does the heater follow its target? Loaded for every ordinary heater, with or without a section.

Checked once a second, by state:

- holding: the temperature has reached the target. The error below target - hysteresis is summed up in degree-seconds.
  A sum of `max_error` is a fault. Being near the target again sets it to zero.
- heating: the target was raised. The temperature must rise by `heating_gain` within each `check_gain_time`.
- idle: no target.
"""

from __future__ import annotations

import enum
import logging
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

CHECK_INTERVAL_S = 1.0

HINT = (
    "This can come from a loose or broken heater or sensor, or from limits in its [verify_heater] section"
    " that are too tight for a healthy machine. Check the wiring before anything else."
)


@dataclass(frozen=True, slots=True)
class VerifyParameters:
    """Options of the section."""

    hysteresis_c: float
    max_error_c_s: float
    heating_gain_c: float
    check_gain_s: float


class Phase(enum.Enum):
    """What the heater is supposed to be doing."""

    IDLE = enum.auto()
    HEATING = enum.auto()
    HOLDING = enum.auto()


@dataclass(slots=True)
class VerifyState:
    """Memory of the watch."""

    phase: Phase = Phase.IDLE
    target_c: float = 0.0
    error_c_s: float = 0.0
    goal_c: float = 0.0  # while heating: to be reached ...
    deadline_s: float = 0.0  # ... by then


def check(
    parameters: VerifyParameters, state: VerifyState, time_s: float, temp_c: float, target_c: float
) -> bool:
    """One check a second; False means fault."""
    if target_c <= 0.0:
        state.phase = Phase.IDLE
        state.target_c = 0.0
        return True
    near = temp_c >= target_c - parameters.hysteresis_c
    raised = target_c > state.target_c
    state.target_c = target_c
    if near:
        state.phase = Phase.HOLDING
        state.error_c_s = 0.0
        return True
    if state.phase is not Phase.HEATING and (raised or state.phase is Phase.IDLE):
        state.phase = Phase.HEATING
        state.goal_c = temp_c + parameters.heating_gain_c
        state.deadline_s = time_s + parameters.check_gain_s
        return True
    if state.phase is Phase.HEATING:
        if temp_c >= state.goal_c:
            state.goal_c = temp_c + parameters.heating_gain_c
            state.deadline_s = time_s + parameters.check_gain_s
        return time_s < state.deadline_s
    state.error_c_s += (target_c - parameters.hysteresis_c - temp_c) * CHECK_INTERVAL_S
    return state.error_c_s < parameters.max_error_c_s


class HeaterCheck:
    """The watch of one heater."""

    def __init__(self, printer: Printer, heater_name: str, parameters: VerifyParameters) -> None:
        self.printer = printer
        self.heater_name = heater_name
        self.parameters = parameters
        self.state = VerifyState()
        self._heater: Any = None
        self._timer: Any = None

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._on_connect)
        self.printer.register_event_handler("klippy:shutdown", self._on_shutdown)

    def _on_connect(self) -> None:
        if self.printer.get_start_args().get("debugoutput") is not None:
            return  # batch mode: nothing is measured
        self._heater = self.printer.lookup_object("heaters").lookup_heater(self.heater_name)
        reactor = self.printer.get_reactor()
        self._timer = reactor.register_timer(self._on_timer, reactor.NOW)

    def _on_shutdown(self) -> None:
        if self._timer is not None:
            self.printer.get_reactor().update_timer(self._timer, self.printer.get_reactor().NEVER)

    def _on_timer(self, eventtime: float) -> float:
        temp_c, target_c = self._heater.get_temp(eventtime)
        if check(self.parameters, self.state, eventtime, temp_c, target_c):
            return eventtime + CHECK_INTERVAL_S
        text = f"Heater {self.heater_name} not heating at expected rate"
        logging.error("%s: %.1f C of %.1f C, %s", text, temp_c, target_c, self.state)
        self.printer.invoke_shutdown(f"{text}\n{HINT}")
        return self.printer.get_reactor().NEVER


def load_config_prefix(config: ConfigWrapper) -> HeaterCheck:
    heater_name = config.get_name().split()[1]
    slow = heater_name == "heater_bed"
    parameters = VerifyParameters(
        config.getfloat("hysteresis", 5.0, minval=0.0),
        config.getfloat("max_error", 120.0, minval=0.0),
        config.getfloat("heating_gain", 2.0, above=0.0),
        config.getfloat("check_gain_time", 60.0 if slow else 20.0, minval=1.0),
    )
    watch = HeaterCheck(config.get_printer(), heater_name, parameters)
    watch.register()
    return watch
