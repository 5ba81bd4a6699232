"""From the newest temperature to commands of the bridge: the control law's step, and what its output becomes.

Two kinds of law, two drivers; the loop chooses once (driver_for):

    OneOutputDriver    pid, watermark, two-period: one output a period. The law is given the filtered temperature and
                       the static losses as feed-forward; a command waits for the newest measurement.
    PredictiveDriver   a law with a model plans ahead. It is given the blocks, what is pending and what lies ahead. Its
                       next command's place is known ahead of time and may be filled anew by each message; what
                       follows is sent along, so a host that comes late has already sent it.

Drivers remember nothing themselves: LoopState does. Where a command may begin and what it is: bridge.h, in C. A step
of the predictive law with its commands is one call.
"""

from __future__ import annotations

import math
import struct
from functools import partial

import chelper
from thermal.models import heat_loss
from thermal.records import PhaseCommand, PowerRequest, Sample, TempEstimate
from thermal.sensing import features
from thermal.sensing.pipeline import Chain

from . import control_api, predictive
from .loop_records import Ahead, LoopParameters, LoopState
from .timeline import commands_of

PULSE_DELAY_S = (
    0.15  # delay from a sensing pulse until its blocks reach the host, one batch of messages included
)
PROMPT_S = 0.005  # to the MCU, when it matters more that a command comes soon than that it comes in time
RESEND_SHARE = 0.01  # of full power: a smaller change of what is already on its way is not worth a message
SURELY_DRIVING = 1.5  # times the smallest drive: less holding power is met by pulses now and then
PLAN_MAX = 67  # commands of one step, as in bridge.h
_INPUTS = struct.Struct("=6di4x")  # head of struct bridge_inputs
_new_request = partial(tuple.__new__, PowerRequest)


class BridgeDriver:
    """What both kinds have in common. `apart_s`: minimum time after the last command; 0 for a new target."""

    PLANS = False  # the next command's place may be filled anew

    def __init__(self, parameters: LoopParameters, state: LoopState, chain: Chain) -> None:
        self.parameters, self.state, self.chain = parameters, state, chain
        self._ffi, self._lib = chelper.get_ffi()
        timing = parameters.timing
        packed = {
            "timing": {
                name: getattr(timing, name)
                for name in ("block_s", "settle_s", "lead_s", "control_s", "stale_s")
            },
            "actuator": parameters.actuator.packed(),
            "prompt_s": PROMPT_S,
            "resend_w": RESEND_SHARE * parameters.control.power_max_w,
            "pulse_delay_s": PULSE_DELAY_S,
            "heat_25c_j_k": parameters.filter.heat.at_25c_j_k,
            "heat_slope_per_k": parameters.filter.heat.slope_per_k,
            "plans": self.PLANS,
        }
        self._packed = self._ffi.new("struct bridge_params *", packed)
        if parameters.has_looks:
            self._packed.drive = self._ffi.addressof(chain.state, "drive")
        self._commands = self._ffi.new("struct phase_command[]", PLAN_MAX)
        self._trusted_w = parameters.trusted_w

    def step(
        self, before: TempEstimate | None, ahead: Ahead, now_s: float, apart_s: float = math.inf
    ) -> list[PhaseCommand]:
        """The law's step and its commands. `before`: the estimate before the newest one; None: there is no new one."""
        self._decide(before, ahead, now_s)
        return self.command(now_s, apart_s)

    def _decide(self, before: TempEstimate | None, ahead: Ahead, now_s: float) -> None:
        raise NotImplementedError

    def is_held(self) -> bool:
        """Does the drive hold the nozzle with no change planned?"""
        return False

    def switched(self) -> None:
        """The target was turned on or off."""

    def limit_w(self, below_c: float) -> float:
        """Power allowed this far below the target; less while supervision doubts the reading."""
        return min(self._approach_w(below_c), self.state.supervise.limit_w)

    def _approach_w(self, below_c: float) -> float:
        approach, state = self.parameters.approach, self.state
        if state.is_waiting:
            return 0.0
        trusted_w = self._trusted_w
        if below_c < approach.band_c:
            state.arriving = True
        elif below_c > approach.leave_c:
            state.arriving = False
        return min(trusted_w, approach.power_w) if state.arriving else trusted_w

    def _apply(self, inputs: control_api.ControlInput, time_s: float, now_s: float) -> None:
        state, chosen = self.state, self.parameters.control
        out, state.law = chosen.law.step(chosen.parameters, state.law, inputs, time_s)
        state.request = PowerRequest(
            now_s, out.value, out.unlimited, out.proportional, out.integral, out.derivative, out.feedforward
        )
        state.horizon = out.horizon

    def command(self, now_s: float, apart_s: float = math.inf) -> list[PhaseCommand]:
        """The request as commands from the next usable edge on."""
        state = self.state
        horizon = self._ffi.new("struct model_planned[]", state.horizon)
        request = self._ffi.new("struct bridge_request *", (now_s, apart_s, state.target_c))
        request.power_w, request.estimate_s = state.request.power_w, state.estimate.time_s
        request.estimate_c = state.estimate.temp_c
        request.horizon, request.horizon_count = horizon, len(state.horizon)
        count = self._lib.bridge_command(self._packed, state.bridge.raw, request, self._commands)
        return commands_of(self._commands, count)

    def off(self, now_s: float) -> list[PhaseCommand]:
        """The bridge off, as soon as may be."""
        bridge = self.state.bridge
        if not bridge.is_on_from(now_s):
            return []
        time_s = max(now_s + self.parameters.timing.lead_s, bridge.last_before_s(now_s))
        commands = [PhaseCommand(time_s, 0, 0.0)]
        bridge.note(commands, now_s)
        return commands

    def take_over(self, ahead: Ahead) -> None:
        """Another law was in force: begin with the heat that holds the nozzle as it is now."""
        state, parameters, chosen = self.state, self.parameters, self.parameters.control
        self.chain.samples()  # meant for the law before
        state.law, state.horizon = chosen.law.start, ()
        news = state.estimate
        if state.target_c <= 0.0 or not news.valid:
            return
        # What the filter does not explain is whatever the law before had learned: melt, fan, a cold second mass.
        loss_w = heat_loss.loss_w(parameters.loss, news.temp_c)
        holding_w = loss_w - parameters.filter.heat.at(news.temp_c) * self.chain.state.filter.rate_k_s
        seen = Sample(news.time_s, news.time_s, news.temp_c, 0.0, state.request.power_w)
        inputs = control_api.ControlInput(
            news.temp_c, news.temp_c, loss_w, samples=(seen,), flow_mm3_s=ahead.flow, fan=ahead.fan
        )
        state.law = chosen.law.follow(chosen.parameters, state.law, inputs, holding_w)


class OneOutputDriver(BridgeDriver):
    """For laws without a model."""

    def switched(self) -> None:
        self.state.law = self.parameters.control.law.start

    def _decide(self, before: TempEstimate | None, ahead: Ahead, now_s: float) -> None:
        state, parameters = self.state, self.parameters
        if before is None:
            return
        if state.target_c <= 0.0:
            state.request = PowerRequest(now_s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            return
        news, phase_max = state.estimate, parameters.front.phase_max_ticks
        step = features.power_fraction(news.phase_ticks, phase_max) - features.power_fraction(
            before.phase_ticks, phase_max
        )
        inputs = control_api.ControlInput(
            state.target_c,
            news.temp_c,
            heat_loss.loss_w(parameters.loss, state.target_c),
            self.limit_w(state.target_c - news.temp_c),
            abs(step) > parameters.approach.rebase_fraction,
        )
        self._apply(inputs, news.time_s, now_s)


class PredictiveDriver(BridgeDriver):
    """For laws that plan ahead by a model, and for the runs of a calibration."""

    PLANS = True

    def __init__(self, parameters: LoopParameters, state: LoopState, chain: Chain) -> None:
        super().__init__(parameters, state, chain)
        self._inputs = self._ffi.new("struct bridge_inputs *")
        self._figures = self._ffi.buffer(self._inputs)
        self._found = predictive.StepOutput()
        self._ahead: Ahead | None = None  # what the inputs point to
        self._follows_drive = parameters.approach.rebase_fraction == math.inf
        chosen = parameters.control
        self._model = chosen.parameters.packed() if chosen.law is predictive.MODEL else None

    def is_held(self) -> bool:
        state, request = self.state, self.state.request
        holding_w = request.feedforward_w + request.integral_w
        sure_w = SURELY_DRIVING * self.parameters.actuator.power_low_w
        return not state.horizon and state.bridge.driving and holding_w >= sure_w

    def limit_w(self, below_c: float) -> float:
        # With a sensing law that follows the drive the control law knows when to stop.
        if not self._follows_drive:
            return super().limit_w(below_c)
        return 0.0 if self.state.is_waiting else min(self._trusted_w, self.state.supervise.limit_w)

    def step(
        self, before: TempEstimate | None, ahead: Ahead, now_s: float, apart_s: float = math.inf
    ) -> list[PhaseCommand]:
        """Blocks without a temperature carry the heat that went in."""
        if self._model is None:
            return super().step(before, ahead, now_s, apart_s)
        state, inputs, found, samples = self.state, self._inputs, self._found, self.chain.samples()
        _INPUTS.pack_into(
            self._figures,
            0,
            now_s,
            apart_s,
            state.target_c,
            self._limit_now_w(),
            state.estimate.time_s,
            state.estimate.temp_c,
            samples.size,
        )
        inputs.samples = samples.raw
        if ahead != self._ahead:
            self._point_to(ahead)
        after = found.new_state()
        count = self._lib.bridge_step(
            self._packed,
            state.bridge.raw,
            self._model,
            state.law.raw,
            inputs,
            after,
            found.raw,
            self._commands,
        )
        state.law = predictive.ModelState(after)
        figures, state.horizon = found.read()
        state.request = _new_request((now_s, *figures[:6]))
        return commands_of(self._commands, count)

    def _point_to(self, ahead: Ahead) -> None:
        inputs, self._ahead = self._inputs, ahead
        inputs.flow, inputs.fan = ahead.flow.packed(), ahead.fan.packed()
        inputs.reference = ahead.reference.packed() if ahead.reference is not None else self._ffi.NULL

    def _limit_now_w(self) -> float:
        state = self.state
        return self.limit_w(state.target_c - state.estimate.temp_c) if state.target_c > 0.0 else 0.0

    def _decide(self, before: TempEstimate | None, ahead: Ahead, now_s: float) -> None:
        """The step of a calibration's run."""
        inputs = control_api.ControlInput(
            self.state.target_c,
            math.nan,
            limit=self._limit_now_w(),
            samples=self.chain.samples(),
            reference=ahead.reference,
            flow_mm3_s=ahead.flow,
            fan=ahead.fan,
        )
        self._apply(inputs, self.state.estimate.time_s, now_s)


def driver_for(parameters: LoopParameters, state: LoopState, chain: Chain) -> BridgeDriver:
    """The kind that the control law needs."""
    kind = PredictiveDriver if parameters.control.models else OneOutputDriver
    return kind(parameters, state, chain)
