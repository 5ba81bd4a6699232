"""The whole chain of one induction nozzle, without a printer: blocks in, phase commands out.

    on_blocks(blocks, now) ─ chain ─ control law ─ actuate ─> [PhaseCommand]
    on_timer(now)          ─ the same without news: keeps the bridge's watchdog fed, or steps back to sensing

When: a message brings the blocks of about 5 ms; each one makes a control step. The new phase is to start on
the edge between two blocks, so that no block is cut: the first edge that lies at least `lead_s` ahead (time
for the command to reach the MCU and for a busy host). A misjudged edge costs one short block, nothing else.
The commands a verb returns replace all that the bridge was told for times from the first of them on: a law
with a model sends along what it means to do next, and a host that comes late has already said it.

Which law: any of control_api's (`LoopParameters.control`). A law without a model is given the filtered
temperature and the static losses as feed-forward; the model law gets the blocks, what is pending, and the
planned flow and reference ahead.

The bridge turns itself off when it hears nothing for `max_duration`; `refresh_s` is a third of that. A loop
that has not seen a temperature for `stale_s` does not heat on blindly: it falls back to the least phase that
still measures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from thermal.models import heat_loss
from thermal.models.melt_exchange import MeltExchange
from thermal.records import PhaseCommand, Planned, PowerRequest, Sample, SampleBlock, TempEstimate
from thermal.sensing import block_temperature, features, heat_balance_monitor, supervision, temperature_filter
from thermal.sensing.blocks import Blocks
from thermal.sensing.pipeline import Chain

from . import actuator, control_api
from .timeline import NOT_COMMANDED, TIME_SLACK_S, Timeline, Timing

__all__ = ["NOT_COMMANDED", "Approach", "Control", "InductionLoop", "LoopParameters", "LoopState", "Timing"]

BALANCE_S = 0.1
HEARD_S = 0.15  # delay from a sensing pulse until its blocks reach the host, one batch of messages included
PROMPT_S = 0.005  # to the MCU, when it matters more that a command comes soon than that it comes in time
RESAY_SHARE = 0.01  # of full power: a smaller change of what is already on its way is not worth a message


@dataclass(frozen=True, slots=True)
class Approach:
    """Less power near the target, where the temperature must be known well.

    The exp and eq5 laws rest on tables at 0.2, 10, 20 and 100 % power and are good to 2.5 degC up to 20 %;
    between 30 and 90 % the reference tank reads up to 25 degC too much. Full power is for the way, not for
    the arrival. A calibrated tank law follows the drive and arrives with more.
    """

    power_w: float = 42.2  # heat at 20 % power
    band_c: float = 45.0  # within this of the target: more than the laws err plus 50 ms of full power
    leave_c: float = 80.0  # hysteresis: farther than this is the way again

    # A step of p = (phase/45000)^2 by more than this moves the reading by degrees without any heat: not a
    # slope.
    rebase_fraction: float = 0.1


@dataclass(frozen=True, slots=True)
class Control:
    """A control law with its parameters; output in watts."""

    law: control_api.Law[Any, Any]
    parameters: Any
    power_max_w: float
    models: bool = False  # the law knows losses, delays and flow itself
    cycle_c: float = (
        0.0  # the law swings: it is at its target from so far below on, and nothing comes of waiting
    )
    beyond_c: float = 0.0  # the greatest target lies so far below max_temp, because the law swings


@dataclass(frozen=True, slots=True)
class LoopParameters:
    """Everything one nozzle's chain is told."""

    front: features.FeatureParameters
    estimator: block_temperature.EstimatorParameters
    control: Control
    loss: heat_loss.LossLaw
    actuator: actuator.ActuatorParameters
    supervise: supervision.SuperviseParameters
    timing: Timing
    approach: Approach
    track: temperature_filter.TrackParameters
    plausible: heat_balance_monitor.PlausibleParameters
    melt: MeltExchange = field(default_factory=MeltExchange)


# (block, its filtered estimate or None, print time of its arrival)
BlockListener = Callable[[SampleBlock, TempEstimate | None, float], None]

# Where a chain begins.
NO_REQUEST = PowerRequest(-math.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NOT_MEASURED = TempEstimate(math.nan, math.nan, math.nan, math.nan, math.nan, 0, False, "not measured yet")


@dataclass(slots=True)
class LoopState:
    """Memory of the chain and what the status shows."""

    target_c: float = 0.0
    estimate: TempEstimate = NOT_MEASURED  # newest valid one
    request: PowerRequest = NO_REQUEST
    line: Timeline = field(default_factory=Timeline)  # commands sent
    horizon: tuple[Planned, ...] = ()  # what the law means to do after its request
    decided_s: float = -math.inf  # last control step
    settled_s: float = math.inf  # since when the estimate has been near the target
    arriving: bool = False  # near the target, power limited
    law: Any = None  # memory of the control law
    actuator: actuator.ActuatorState = field(default_factory=actuator.ActuatorState)
    supervise: supervision.SuperviseState = field(default_factory=supervision.SuperviseState)
    plausible: heat_balance_monitor.PlausibleState = field(
        default_factory=heat_balance_monitor.PlausibleState
    )
    balanced_s: float = -math.inf  # when that was
    warning: str = ""  # plausibility: text for people
    latency_s: float = 0.0  # newest: from the centre of a block to its value here

    @property
    def commanded(self) -> PhaseCommand:
        """Newest command sent; of a plan its first."""
        return self.line.head


class InductionLoop:
    """One nozzle. All times are print times; every verb returns the commands to send, in order of time."""

    SETTLED_C = 1.0  # "at temperature": within this of the target ...
    SETTLED_S = 0.25  # ... for this long

    def __init__(self, parameters: LoopParameters) -> None:
        self.chain = Chain()  # blocks to temperatures, with its own memory
        self.parameters = parameters
        self.state = LoopState()
        self.listeners: list[BlockListener] = []  # given every block, in order
        self.on_listener_error: Callable[[Exception], None] = lambda problem: None
        self.quiet = True  # told from outside: neither melt nor fan takes heat
        self.flow = control_api.IDLE  # told from outside: planned extrusion, mm^3/s
        self.fan = control_api.IDLE  # told from outside: part fan, 0..1
        self.reference: control_api.Reference | None = None
        self.state.law = parameters.control.law.start

    @property
    def parameters(self) -> LoopParameters:
        """In force; setting them tells the chain, too."""
        return self._parameters

    @parameters.setter
    def parameters(self, p: LoopParameters) -> None:
        self._parameters = p
        self.chain.use(p.front, p.estimator, p.supervise, p.actuator.law, p.track)

    @property
    def fault(self) -> str:
        """Text for people, "" while all is well."""
        return self.state.supervise.fault

    def start(self, now_s: float) -> None:
        """The bridge is off and blocks are about to come."""
        supervision.start(self.state.supervise, self.chain.watch, now_s)

    def set_target(self, target_c: float, now_s: float) -> list[PhaseCommand]:
        """New target, 0 = off; acts at once on what is known."""
        state = self.state
        if target_c == state.target_c:
            return []
        if (target_c <= 0.0 or state.target_c <= 0.0) and not self._parameters.control.models:
            state.law = self._parameters.control.law.start
        state.target_c = target_c
        self.reference = None
        state.settled_s = math.inf
        state.arriving = False
        if state.estimate.valid:
            self._decide(state.estimate, state.estimate.phase_ticks, now_s, apart_s=0.0)
        return self._command(now_s, apart_s=0.0)

    def set_reference(
        self, points: Sequence[tuple[float, float]] | control_api.Reference, now_s: float
    ) -> list[PhaseCommand]:
        """The wanted temperature over time, (print time, degC) corners of straight lines: known ahead, met on time.

        Replaces the one before. `target_c` follows it; after the last corner its temperature stays the target.
        set_target ends it. An empty list leaves the target where it is.
        """
        if not points:
            self.reference = None
            return []
        self.reference = control_api.Reference.of(points)
        if self.state.target_c <= 0.0:
            return []  # the heater is off: a plan alone does not turn it on
        self._follow_reference(now_s)
        return []

    def _follow_reference(self, now_s: float) -> None:
        if self.reference is not None and self.state.target_c > 0.0:
            self.state.target_c = self.reference.at(now_s)

    def use(self, parameters: LoopParameters) -> None:
        """Go on with other parameters; another law begins with the heat that holds the nozzle as it is now."""
        state, before = self.state, self._parameters.control
        chosen, self.parameters = parameters.control, parameters
        if chosen.law is before.law:
            return
        self.chain.samples()  # what was to be told to the law before
        state.law, state.horizon = chosen.law.start, ()
        news = state.estimate
        if state.target_c <= 0.0 or not news.valid:
            return
        # What the filter does not explain is whatever the law before had learned: melt, fan, a cold second mass.
        loss_w = heat_loss.loss_w(parameters.loss, news.temp_c)
        holding_w = loss_w - parameters.track.heat.at(news.temp_c) * self.chain.state.track.rate_k_s
        seen = Sample(news.time_s, news.time_s, news.temp_c, 0.0, state.request.power_w)
        inputs = control_api.ControlInput(
            news.temp_c, news.temp_c, loss_w, samples=(seen,), flow_mm3_s=self.flow, fan=self.fan
        )
        state.law = chosen.law.follow(chosen.parameters, state.law, inputs, holding_w)

    def on_blocks(self, blocks: Blocks, now_s: float) -> list[PhaseCommand]:
        """Blocks of one message arrived."""
        state = self.state
        news = self.chain.take(blocks)
        if blocks.count:
            state.line.edge_s = blocks.end_s
        self.tell(blocks, now_s)
        if news is not None:
            before, state.estimate = state.estimate, news
            state.latency_s = now_s - news.time_s
            self._note_settled(news)
            self._note_balance(news)
            self._decide(news, before.phase_ticks, now_s)
        elif self._parameters.control.models and self.chain.waiting:
            # blocks without a temperature still tell the model what heat went in
            self._decide(state.estimate, 0, now_s)
        return self._step(now_s)

    def tell(self, blocks: Blocks, now_s: float, measured: bool = True) -> None:
        """Give blocks to the listeners; `measured`: with the estimates of the chain they went through.

        A listener that fails is removed and its error reported once: control goes on without it.
        """
        if not self.listeners:
            return
        for i, block in enumerate(blocks):
            found = blocks.tracked(i) if measured else None
            for listener in tuple(self.listeners):
                try:
                    listener(block, found, now_s)
                except Exception as problem:
                    if listener in self.listeners:
                        self.listeners.remove(listener)
                    self.on_listener_error(problem)

    def on_timer(self, now_s: float) -> list[PhaseCommand]:
        """Nothing came for a while; also the regular watch."""
        if self._parameters.control.models:
            self._decide(self.state.estimate, 0, now_s)
        return self._step(now_s)

    def resume(self, now_s: float) -> None:
        """Somebody else was at the bridge for a while: nothing remembered of the nozzle holds any more."""
        self.start(now_s)
        self.restart_filter()
        self.state.estimate = NOT_MEASURED
        self.state.line.note([PhaseCommand(now_s, 0, 0.0)], now_s)
        self.chain.samples()
        self.state.law = self._parameters.control.law.start
        self.state.actuator = actuator.ActuatorState()
        self.state.request = NO_REQUEST

    def restart_filter(self) -> None:
        """The law changed: what the filter and the balance remember was told by another one."""
        self.chain.restart_track()
        self.state.law = self._parameters.control.law.start
        self.state.plausible = heat_balance_monitor.PlausibleState()
        self.state.warning = ""

    def is_steady(self) -> bool:
        """Off, or held by a law that plans no change: messages of blocks may come in batches."""
        state = self.state
        if state.target_c <= 0.0:
            return True
        driven = state.actuator.driving and not state.horizon
        return driven and self._parameters.control.models and self.is_settled()

    def is_settled(self) -> bool:
        """At the target, and has been for a little while."""
        state = self.state
        return state.estimate.time_s - state.settled_s >= self.SETTLED_S

    def _note_settled(self, news: TempEstimate) -> None:
        state = self.state
        below_c = state.target_c - news.temp_c
        cycle_c = self._parameters.control.cycle_c
        if below_c > cycle_c if cycle_c else abs(below_c) > self.SETTLED_C:
            state.settled_s = math.inf
        elif state.settled_s == math.inf:
            state.settled_s = news.time_s

    def _note_balance(self, news: TempEstimate) -> None:
        """Ten times a second is enough for a balance over half a minute."""
        state, parameters = self.state, self._parameters
        if news.time_s - state.balanced_s < BALANCE_S or not parameters.supervise.calibrated:
            return
        heat_balance_monitor.observe(
            parameters.plausible,
            state.plausible,
            news.time_s,
            news.temp_c,
            self.chain.take_heat_j(),
            self.quiet,
        )
        state.balanced_s = news.time_s
        state.warning = heat_balance_monitor.warning(parameters.plausible, state.plausible)

    def _limit_w(self, below_c: float) -> float:
        """Power allowed this far below the target."""
        approach, state = self._parameters.approach, self.state
        if below_c < approach.band_c:
            state.arriving = True
        elif below_c > approach.leave_c:
            state.arriving = False
        if self._parameters.control.models and approach.rebase_fraction == math.inf:
            return math.inf  # the law follows the drive, and the control knows when to stop
        return approach.power_w if state.arriving else math.inf

    def _decide(self, news: TempEstimate, phase_before: int, now_s: float, apart_s: float = math.inf) -> None:
        """The control law on the newest temperature; keeps the request with its terms."""
        state, parameters = self.state, self._parameters
        self._follow_reference(now_s)
        if state.target_c <= 0.0 and not parameters.control.models:
            state.request = PowerRequest(now_s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            return
        if parameters.control.models:
            inputs = self._model_input(news, now_s, apart_s)
        else:
            inputs = self._plain_input(news, phase_before)
        self._apply(inputs, news.time_s, now_s)

    def _apply(self, inputs: control_api.ControlInput, time_s: float, now_s: float) -> None:
        state, chosen = self.state, self._parameters.control
        out, state.law = chosen.law.step(chosen.parameters, state.law, inputs, time_s)
        state.request = PowerRequest(
            now_s, out.value, out.unlimited, out.proportional, out.integral, out.derivative, out.feedforward
        )
        state.horizon = out.horizon

    def _plain_input(self, news: TempEstimate, phase_before: int) -> control_api.ControlInput:
        """For laws without a model: the filtered temperature, the static losses fed forward."""
        state, parameters = self.state, self._parameters
        phase_max = parameters.front.phase_max_ticks
        step = features.power_fraction(news.phase_ticks, phase_max) - features.power_fraction(
            phase_before, phase_max
        )
        return control_api.ControlInput(
            state.target_c,
            news.temp_c,
            heat_loss.loss_w(parameters.loss, state.target_c),
            self._limit_w(state.target_c - news.temp_c),
            abs(step) > parameters.approach.rebase_fraction,
        )

    def _model_input(self, news: TempEstimate, now_s: float, apart_s: float) -> control_api.ControlInput:
        """For the model law: all that was measured since the step before, what is pending, what lies ahead."""
        state, timing = self.state, self._parameters.timing
        samples = self.chain.samples()
        apply_s = self._slot(now_s, apart_s) or now_s + timing.lead_s
        since_s = samples.end_s if samples else state.line.edge_s
        limit_w = self._limit_w(state.target_c - news.temp_c) if state.target_c > 0.0 else 0.0
        return control_api.ControlInput(
            state.target_c,
            math.nan,
            limit=limit_w,
            applied=samples.output if samples else state.line.last_before(since_s).power_w,
            apply_s=apply_s,
            samples=samples,
            pending=state.line.pending(since_s - TIME_SLACK_S, apply_s - TIME_SLACK_S),
            reference=self.reference,
            flow_mm3_s=self.flow,
            fan=self.fan,
        )

    def _step(self, now_s: float) -> list[PhaseCommand]:
        state, parameters = self.state, self._parameters
        state.decided_s = now_s
        fraction = state.request.power_w / parameters.control.power_max_w
        temp_c = state.estimate.temp_c
        fault = supervision.watch(
            parameters.supervise, state.supervise, self.chain.watch, now_s, temp_c, state.target_c, fraction
        )
        if fault:
            state.target_c = 0.0
            return self._off(now_s)
        return self._command(now_s)

    def _off(self, now_s: float) -> list[PhaseCommand]:
        state = self.state
        if not state.line.is_on_from(now_s):
            return []
        time_s = max(now_s + self._parameters.timing.lead_s, state.line.last_before(now_s).time_s)
        commands = [PhaseCommand(time_s, 0, 0.0)]
        state.line.note(commands, now_s)
        return commands

    def _command(self, now_s: float, apart_s: float = math.inf) -> list[PhaseCommand]:
        """Turn the request into commands from the next usable edge on, at least `apart_s` after the last."""
        state, parameters = self.state, self._parameters
        timing = parameters.timing
        at_s = self._slot(now_s, apart_s)
        if at_s is None:
            return []
        power_w = state.request.power_w if state.target_c > 0.0 else 0.0
        horizon = state.horizon if state.target_c > 0.0 else ()
        if power_w > 0.0 and not now_s - state.estimate.time_s <= timing.stale_s + self._interval_s():
            power_w, horizon = parameters.actuator.power_low_w, ()
        taken = state.line.at(at_s)
        if taken is not None and apart_s > 0.0 and not self._improves(taken, power_w, horizon):
            return []
        idle = state.target_c <= 0.0 and self._is_heard(now_s)
        # A horizon may turn on again a bridge that is off; a booked pulse ends by itself and stays.
        is_on = state.line.is_on_from(max(at_s, state.actuator.last_excited_s))
        commands = actuator.actuate(parameters.actuator, state.actuator, power_w, at_s, is_on, idle)
        if len(commands) == 1 and horizon:
            commands += actuator.ahead(parameters.actuator, commands[0], horizon)
        state.line.note(commands, now_s)
        return commands

    def _is_heard(self, now_s: float) -> bool:
        """The pulses of an idle bridge are heard. On a line that loses some the next one is not waited for so long."""
        return now_s - self.state.estimate.time_s <= self._parameters.actuator.idle_interval_s + HEARD_S

    def _slot(self, now_s: float, apart_s: float) -> float | None:
        """Where a command sent now may begin; None: it is too soon after the last.

        The model law's next place is held for it ahead of time and may be filled anew by each message; a law
        without one waits for the newest measurement instead.
        """
        state, timing = self.state, self._parameters.timing
        apart_s = min(apart_s, timing.control_s)
        if self._parameters.control.models:
            # A new target need not wait for a late host: late, it holds from its arrival on.
            lead_s = timing.lead_s if apart_s > 0.0 else min(timing.lead_s, PROMPT_S)
            return state.line.slot(timing, now_s, apart_s - TIME_SLACK_S, lead_s)
        at_s = state.line.edge(timing, now_s + timing.lead_s)
        taken_s = state.line.newest.time_s + max(TIME_SLACK_S, apart_s - TIME_SLACK_S)
        return at_s if at_s > taken_s else None

    def _improves(self, taken: PhaseCommand, power_w: float, horizon: tuple[Planned, ...]) -> bool:
        """Is it worth a message to say anew what was said for this edge? Pulses are booked and stay."""
        parameters = self._parameters
        driving = self.state.actuator.driving and power_w >= parameters.actuator.power_low_w
        if not driving or not parameters.control.models or not taken.phase_ticks:
            return False
        plan = (Planned(taken.time_s, power_w), *horizon)
        return self.state.line.strays(plan, RESAY_SHARE * parameters.control.power_max_w)

    def _interval_s(self) -> float:
        """Time between measurements that is normal in the present mode of the actuator."""
        return 0.0 if self.state.actuator.driving else self._parameters.actuator.idle_interval_s
