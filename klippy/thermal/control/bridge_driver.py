"""From the newest temperature to commands of the bridge: the control law's step, and what its output becomes.

Two kinds of law, two drivers; the loop chooses once (driver_for):

    OneOutputDriver    pid, watermark, two-period: one output a period. The law is given the filtered temperature and
                       the static losses as feed-forward; a command waits for the newest measurement.
    PredictiveDriver   a law with a model plans ahead. It is given the blocks, what is pending and what lies ahead. Its
                       next command's place is known ahead of time and may be filled anew by each message; what
                       follows is sent along, so a host that comes late has already sent it.

Drivers remember nothing themselves: LoopState does.
"""

from __future__ import annotations

import math

from thermal.models import heat_loss
from thermal.records import PhaseCommand, Planned, PowerRequest, Sample, TempEstimate
from thermal.sensing import features
from thermal.sensing.pipeline import Chain

from . import actuator, control_api
from .loop_records import Ahead, LoopParameters, LoopState
from .timeline import TIME_SLACK_S

PULSE_DELAY_S = (
    0.15  # delay from a sensing pulse until its blocks reach the host, one batch of messages included
)
PROMPT_S = 0.005  # to the MCU, when it matters more that a command comes soon than that it comes in time
RESAY_SHARE = 0.01  # of full power: a smaller change of what is already on its way is not worth a message


class BridgeDriver:
    """What both kinds have in common. `apart_s`: minimum time after the last command; 0 for a new target."""

    def __init__(self, parameters: LoopParameters, state: LoopState, chain: Chain) -> None:
        self.parameters, self.state, self.chain = parameters, state, chain

    def decide(
        self, before: TempEstimate | None, ahead: Ahead, now_s: float, apart_s: float = math.inf
    ) -> None:
        """The law's step. `before`: the estimate before the newest one; None: there is no new one."""
        raise NotImplementedError

    def slot(self, now_s: float, apart_s: float) -> float | None:
        """Where a command sent now may begin; None: it is too soon after the last."""
        raise NotImplementedError

    def improves(self, taken: PhaseCommand, power_w: float, horizon: tuple[Planned, ...]) -> bool:
        """Is it worth a message to send anew what was sent for this edge?"""
        return False

    def is_held(self) -> bool:
        """Does the drive hold the nozzle with no change planned?"""
        return False

    def switched(self) -> None:
        """The target was turned on or off."""

    def limit_w(self, below_c: float) -> float:
        """Power allowed this far below the target."""
        approach, state = self.parameters.approach, self.state
        if below_c < approach.band_c:
            state.arriving = True
        elif below_c > approach.leave_c:
            state.arriving = False
        return approach.power_w if state.arriving else math.inf

    def _apply(self, inputs: control_api.ControlInput, time_s: float, now_s: float) -> None:
        state, chosen = self.state, self.parameters.control
        out, state.law = chosen.law.step(chosen.parameters, state.law, inputs, time_s)
        state.request = PowerRequest(
            now_s, out.value, out.unlimited, out.proportional, out.integral, out.derivative, out.feedforward
        )
        state.horizon = out.horizon

    def command(self, now_s: float, apart_s: float = math.inf) -> list[PhaseCommand]:
        """The request as commands from the next usable edge on."""
        state, parameters = self.state, self.parameters
        at_s = self.slot(now_s, apart_s)
        if at_s is None:
            return []
        power_w = state.request.power_w if state.target_c > 0.0 else 0.0
        horizon = state.horizon if state.target_c > 0.0 else ()
        if power_w > 0.0 and not now_s - state.estimate.time_s <= self._stale_s():
            power_w, horizon = parameters.actuator.power_low_w, ()
        taken = state.line.at(at_s)
        if taken is not None and apart_s > 0.0 and not self.improves(taken, power_w, horizon):
            return []
        idle = state.target_c <= 0.0 and self._pulses_arrive(now_s)
        # A horizon may turn on again a bridge that is off; a booked pulse ends by itself and stays.
        is_on = state.line.is_on_from(max(at_s, state.actuator.last_excited_s))
        commands = actuator.actuate(parameters.actuator, state.actuator, power_w, at_s, is_on, idle)
        if len(commands) == 1 and horizon:
            commands += actuator.ahead(parameters.actuator, commands[0], horizon)
        if commands and parameters.supervise.calibrated:
            rate_k_s = power_w / parameters.filter.heat.at(state.estimate.temp_c)
            doubt_c = math.sqrt(self.chain.state.drive.variance)
            looked = actuator.with_look(parameters.actuator, state.actuator, commands, rate_k_s, doubt_c)
            state.line.note(looked, now_s)
            state.line.head = commands[0]
            return looked
        state.line.note(commands, now_s)
        return commands

    def off(self, now_s: float) -> list[PhaseCommand]:
        """The bridge off, as soon as may be."""
        state = self.state
        if not state.line.is_on_from(now_s):
            return []
        time_s = max(now_s + self.parameters.timing.lead_s, state.line.last_before(now_s).time_s)
        commands = [PhaseCommand(time_s, 0, 0.0)]
        state.line.note(commands, now_s)
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

    def _pulses_arrive(self, now_s: float) -> bool:
        """Do blocks of the idle bridge's pulses arrive? On a line that loses some the next pulse comes sooner."""
        return now_s - self.state.estimate.time_s <= self.parameters.actuator.idle_interval_s + PULSE_DELAY_S

    def _stale_s(self) -> float:
        """A temperature older than this is none, in the present mode of the actuator."""
        parameters, driving = self.parameters, self.state.actuator.driving
        return parameters.timing.stale_s + (0.0 if driving else parameters.actuator.idle_interval_s)


class OneOutputDriver(BridgeDriver):
    """For laws without a model."""

    def switched(self) -> None:
        self.state.law = self.parameters.control.law.start

    def decide(
        self, before: TempEstimate | None, ahead: Ahead, now_s: float, apart_s: float = math.inf
    ) -> None:
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

    def slot(self, now_s: float, apart_s: float) -> float | None:
        state, timing = self.state, self.parameters.timing
        at_s = state.line.edge(timing, now_s + timing.lead_s)
        apart_s = min(apart_s, timing.control_s)
        taken_s = state.line.newest.time_s + max(TIME_SLACK_S, apart_s - TIME_SLACK_S)
        return at_s if at_s > taken_s else None


class PredictiveDriver(BridgeDriver):
    """For laws that plan ahead by a model."""

    def is_held(self) -> bool:
        return self.state.actuator.driving and not self.state.horizon

    def limit_w(self, below_c: float) -> float:
        limit_w = super().limit_w(below_c)
        # With a sensing law that follows the drive the control law knows when to stop.
        return math.inf if self.parameters.approach.rebase_fraction == math.inf else limit_w

    def decide(
        self, before: TempEstimate | None, ahead: Ahead, now_s: float, apart_s: float = math.inf
    ) -> None:
        """Blocks without a temperature carry the heat that went in."""
        state, samples = self.state, self.chain.samples()
        apply_s = self.slot(now_s, apart_s)
        since_s = samples.end_s if samples else state.line.edge_s
        inputs = control_api.ControlInput(
            state.target_c,
            math.nan,
            limit=self.limit_w(state.target_c - state.estimate.temp_c) if state.target_c > 0.0 else 0.0,
            applied=samples.output if samples else state.line.last_before(since_s).power_w,
            apply_s=apply_s,
            samples=samples,
            pending=state.line.pending(since_s - TIME_SLACK_S, apply_s - TIME_SLACK_S),
            reference=ahead.reference,
            flow_mm3_s=ahead.flow,
            fan=ahead.fan,
        )
        self._apply(inputs, state.estimate.time_s, now_s)

    def slot(self, now_s: float, apart_s: float) -> float:
        timing = self.parameters.timing
        # A new target need not wait for a late host: late, it holds from its arrival on.
        lead_s = timing.lead_s if apart_s > 0.0 else min(timing.lead_s, PROMPT_S)
        apart_s = min(apart_s, timing.control_s)
        return self.state.line.slot(timing, now_s, apart_s - TIME_SLACK_S, lead_s)

    def improves(self, taken: PhaseCommand, power_w: float, horizon: tuple[Planned, ...]) -> bool:
        """Pulses are booked and stay."""
        parameters = self.parameters
        driving = self.state.actuator.driving and power_w >= parameters.actuator.power_low_w
        if not driving or not taken.phase_ticks:
            return False
        plan = (Planned(taken.time_s, power_w), *horizon)
        return self.state.line.differs(plan, RESAY_SHARE * parameters.control.power_max_w)


def driver_for(parameters: LoopParameters, state: LoopState, chain: Chain) -> BridgeDriver:
    kind = PredictiveDriver if parameters.control.models else OneOutputDriver
    return kind(parameters, state, chain)
