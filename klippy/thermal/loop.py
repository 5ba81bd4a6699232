"""The whole chain of one induction nozzle, without a printer: blocks in, phase commands out.

    on_blocks(blocks, now) ─ features ─ estimate ─ track ─ PID + loss feed-forward ─ actuate ─> [PhaseCommand]
    on_timer(now)          ─ the same without news: keeps the bridge's watchdog fed, or steps back to sensing

When: a message brings the blocks of about 5 ms; each one makes a control step. The new phase is to start on
the edge between two blocks, so that no block is cut: the first edge that lies at least `lead_s` ahead (time
for the command to reach the MCU and for a busy host). A misjudged edge costs one short block, nothing else.

    blocks  |settle|--block--|--block--|--block--|--block--|
                             ^ known edge        ^ edge >= now + lead: the command's time

The bridge turns itself off when it hears nothing for `max_duration`; `refresh_s` is a third of that. A loop
that has not seen a temperature for `stale_s` does not heat on blindly: it falls back to the least phase that
still measures.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from . import actuator, control, estimator, features, model, plausible, supervise, track
from .records import PhaseCommand, PowerRequest, SampleBlock, TempEstimate

BALANCE_S = 0.1
TIME_SLACK_S = 1e-7  # rounding of print times against clocks, far below a bridge period


@dataclass(frozen=True, slots=True)
class Timing:
    """When commands may start and how blocks lie in time."""

    block_s: float  # whole block
    settle_s: float  # discarded after a phase step
    lead_s: float  # a command is sent at least this much before it holds
    refresh_s: float  # longest time between commands while the bridge is on
    stale_s: float = 0.15  # no temperature for this long: stop heating blindly
    control_s: float = 0.0  # commands are at least this much apart: a step costs settling samples


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
class LoopParameters:
    """Everything one nozzle's chain is told."""

    front: features.FeatureParameters
    estimator: estimator.EstimatorParameters
    pid: control.PidParameters  # watts
    loss: model.LossLaw
    actuator: actuator.ActuatorParameters
    supervise: supervise.SuperviseParameters
    timing: Timing
    approach: Approach
    track: track.TrackParameters
    plausible: plausible.PlausibleParameters


# (block, its filtered estimate or None, print time of its arrival)
BlockListener = Callable[[SampleBlock, TempEstimate | None, float], None]

# Where a chain begins.
NO_REQUEST = PowerRequest(-math.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NOT_COMMANDED = PhaseCommand(-math.inf, 0, 0.0)
NOT_MEASURED = TempEstimate(math.nan, math.nan, math.nan, math.nan, math.nan, 0, False, "not measured yet")


@dataclass(slots=True)
class LoopState:
    """Memory of the chain and what the status shows."""

    target_c: float = 0.0
    estimate: TempEstimate = NOT_MEASURED  # newest valid one
    request: PowerRequest = NO_REQUEST
    commanded: PhaseCommand = NOT_COMMANDED  # newest command sent
    decided_s: float = -math.inf  # last control step
    edge_s: float = -math.inf  # an edge between two blocks
    settled_s: float = math.inf  # since when the estimate has been near the target
    arriving: bool = False  # near the target, power limited
    pid: control.PidState = field(default_factory=control.PidState)
    actuator: actuator.ActuatorState = field(default_factory=actuator.ActuatorState)
    supervise: supervise.SuperviseState = field(default_factory=supervise.SuperviseState)
    track: track.TrackState = field(default_factory=track.TrackState)
    plausible: plausible.PlausibleState = field(default_factory=plausible.PlausibleState)
    heat_j: float = 0.0  # put in since the newest heat balance
    balanced_s: float = -math.inf  # when that was
    noise: features.NoiseState = field(default_factory=features.NoiseState)
    warning: str = ""  # plausibility: text for people
    latency_s: float = 0.0  # newest: from the centre of a block to its value here


class InductionLoop:
    """One nozzle. All times are print times; every verb returns the commands to send, in order of time."""

    SETTLED_C = 1.0  # "at temperature": within this of the target ...
    SETTLED_S = 0.25  # ... for this long

    def __init__(self, parameters: LoopParameters) -> None:
        self.parameters = parameters
        self.state = LoopState()
        self.listeners: list[BlockListener] = []  # told of every block, in order
        self.quiet = True  # told from outside: neither melt nor fan takes heat

    @property
    def fault(self) -> str:
        """Text for people, "" while all is well."""
        return self.state.supervise.fault

    def start(self, now_s: float) -> None:
        """The bridge is off and blocks are about to come."""
        supervise.start(self.state.supervise, now_s)

    def set_target(self, target_c: float, now_s: float) -> list[PhaseCommand]:
        """New target, 0 = off; acts at once on what is known."""
        state = self.state
        if target_c == state.target_c:
            return []
        if target_c <= 0.0 or state.target_c <= 0.0:
            state.pid = control.PidState()
        state.target_c = target_c
        state.settled_s = math.inf
        state.arriving = False
        if state.estimate.valid:
            self._decide(state.estimate, state.estimate.phase_ticks, now_s)
        return self._command(now_s, apart_s=0.0)

    def on_blocks(self, blocks: list[SampleBlock], now_s: float) -> list[PhaseCommand]:
        """Blocks of one message arrived."""
        state = self.state
        news = None
        for block in blocks:
            found = self._take(block)
            news = found or news
            for listener in self.listeners:
                listener(block, found, now_s)
        if news is not None:
            before, state.estimate = state.estimate, news
            state.latency_s = now_s - news.time_s
            self._note_settled(news)
            self._note_balance(news)
            self._decide(news, before.phase_ticks, now_s)
        return self._step(now_s)

    def _take(self, block: SampleBlock) -> TempEstimate | None:
        """One block through conversion, supervision and filter."""
        parameters, state = self.parameters, self.state
        end_s = block.time_s + block.duration_s
        state.edge_s = end_s
        result = None
        if block.phase_ticks:
            result = estimator.estimate(parameters.estimator, features.extract(parameters.front, block))
        supervise.observe(parameters.supervise, state.supervise, end_s, result)
        heat_w = parameters.actuator.law.power_w(block.phase_ticks)
        settle_s = block.discarded * block.duration_s / block.count
        state.heat_j += heat_w * (block.duration_s + settle_s)
        features.note_noise(state.noise, block)
        return track.track(parameters.track, state.track, block, heat_w, result)

    def on_timer(self, now_s: float) -> list[PhaseCommand]:
        """Nothing came for a while; also the regular watch."""
        return self._step(now_s)

    def resume(self, now_s: float) -> None:
        """Somebody else was at the bridge for a while: nothing remembered of the nozzle holds any more."""
        self.start(now_s)
        self.restart_filter()
        self.state.estimate = NOT_MEASURED
        self.state.commanded = PhaseCommand(now_s, 0, 0.0)
        self.state.actuator = actuator.ActuatorState()
        self.state.request = NO_REQUEST

    def restart_filter(self) -> None:
        """The law changed: what the filter and the balance remember was told by another one."""
        self.state.track = track.TrackState()
        self.state.plausible = plausible.PlausibleState()
        self.state.warning = ""

    def is_settled(self) -> bool:
        """At the target, and has been for a little while."""
        state = self.state
        return state.estimate.time_s - state.settled_s >= self.SETTLED_S

    def _note_settled(self, news: TempEstimate) -> None:
        state = self.state
        if abs(news.temp_c - state.target_c) > self.SETTLED_C:
            state.settled_s = math.inf
        elif state.settled_s == math.inf:
            state.settled_s = news.time_s

    def _note_balance(self, news: TempEstimate) -> None:
        """Ten times a second is enough for a balance over half a minute."""
        state, parameters = self.state, self.parameters
        if news.time_s - state.balanced_s < BALANCE_S or not parameters.supervise.calibrated:
            return
        plausible.observe(
            parameters.plausible, state.plausible, news.time_s, news.temp_c, state.heat_j, self.quiet
        )
        state.heat_j = 0.0
        state.balanced_s = news.time_s
        state.warning = plausible.warning(parameters.plausible, state.plausible)

    def _limit_w(self, below_c: float) -> float:
        """Power allowed this far below the target."""
        approach, state = self.parameters.approach, self.state
        if below_c < approach.band_c:
            state.arriving = True
        elif below_c > approach.leave_c:
            state.arriving = False
        return approach.power_w if state.arriving else math.inf

    def _decide(self, news: TempEstimate, phase_before: int, now_s: float) -> None:
        """PID on the newest temperature; keeps the request with its terms."""
        state, parameters = self.state, self.parameters
        if state.target_c <= 0.0:
            state.request = PowerRequest(now_s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            return
        phase_max = parameters.front.phase_max_ticks
        step = features.power_fraction(news.phase_ticks, phase_max) - features.power_fraction(
            phase_before, phase_max
        )
        inputs = control.ControlInput(
            state.target_c,
            news.temp_c,
            model.loss_w(parameters.loss, state.target_c),
            self._limit_w(state.target_c - news.temp_c),
            abs(step) > parameters.approach.rebase_fraction,
        )
        out, state.pid = control.pid_step(parameters.pid, state.pid, inputs, news.time_s)
        state.request = PowerRequest(
            now_s, out.value, out.unlimited, out.proportional, out.integral, out.derivative, out.feedforward
        )

    def _step(self, now_s: float) -> list[PhaseCommand]:
        state, parameters = self.state, self.parameters
        state.decided_s = now_s
        fraction = state.request.power_w / parameters.pid.output_high
        temp_c = state.estimate.temp_c
        fault = supervise.watch(
            parameters.supervise, state.supervise, now_s, temp_c, state.target_c, fraction
        )
        if fault:
            state.target_c = 0.0
            return self._off(now_s)
        return self._command(now_s)

    def _off(self, now_s: float) -> list[PhaseCommand]:
        state = self.state
        if not state.commanded.phase_ticks:
            return []
        time_s = max(now_s + self.parameters.timing.lead_s, state.commanded.time_s)
        state.commanded = PhaseCommand(time_s, 0, 0.0)
        return [state.commanded]

    def _command(self, now_s: float, apart_s: float = math.inf) -> list[PhaseCommand]:
        """Turn the request into commands from the next usable edge on, at least `apart_s` after the last."""
        state, parameters = self.state, self.parameters
        timing = parameters.timing
        at_s = self._next_edge(now_s + timing.lead_s)
        if at_s <= state.commanded.time_s + max(TIME_SLACK_S, min(apart_s, timing.control_s) - TIME_SLACK_S):
            return []  # the edge is taken by a command already sent, or it is too soon after one
        power_w = state.request.power_w if state.target_c > 0.0 else 0.0
        if power_w > 0.0 and not now_s - state.estimate.time_s <= timing.stale_s + self._interval_s():
            power_w = parameters.actuator.power_low_w
        idle = state.target_c <= 0.0
        commands = actuator.actuate(parameters.actuator, state.actuator, power_w, at_s, idle)
        if commands:
            state.commanded = commands[-1]
        return commands

    def _interval_s(self) -> float:
        """Time between measurements that is normal in the present mode of the actuator."""
        return 0.0 if self.state.actuator.driving else self.parameters.actuator.idle_interval_s

    def _next_edge(self, earliest_s: float) -> float:
        """First edge between two blocks not before `earliest_s`, given the commands already sent."""
        state, timing = self.state, self.parameters.timing
        edge_s = state.edge_s
        if state.commanded.time_s > edge_s:
            edge_s = state.commanded.time_s + timing.settle_s
        if edge_s == -math.inf:
            return earliest_s
        blocks = math.ceil((earliest_s - edge_s) / timing.block_s - 1e-6)
        return edge_s + max(0, blocks) * timing.block_s
