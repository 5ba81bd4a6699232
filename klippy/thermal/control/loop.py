"""The whole chain of one induction nozzle, without a printer: blocks in, phase commands out.

    on_blocks(blocks, now) ─ sense ─ watch ─ law ─ actuator ─> [PhaseCommand]
    on_timer(now)          ─ the same without new blocks: feeds the bridge's watchdog, or goes back to sensing

Each message of blocks (5 ms; while holding, a batch of two or four) makes one control step. A new phase starts on an
edge between two blocks, so that no block is cut. It is the first edge at least `lead_s` ahead: time for a busy host and
for the link. A misjudged edge costs one short block. The returned commands replace all that was sent before for times
from the first of them on. bridge_driver.py runs the control law (`LoopParameters.control`).

The bridge turns itself off after `max_duration` without a command; `refresh_s` is a third of that. Without a
temperature for `stale_s` the loop does not heat: it goes back to the smallest phase that still measures. Without blocks
the bridge is off. It then goes on where it left off: a late host, or a line cut for a moment, costs heat only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from thermal.drift import correction as drift
from thermal.records import PhaseCommand, SampleBlock, TempEstimate
from thermal.sensing import heat_balance_monitor, laws, supervision
from thermal.sensing.blocks import Blocks
from thermal.sensing.pipeline import Chain

from . import control_api
from .bridge_driver import driver_for
from .drift_correction import drift_correction
from .loop_records import (
    CALIBRATION,
    NO_REQUEST,
    NOT_MEASURED,
    Ahead,
    Approach,
    Control,
    LoopParameters,
    LoopState,
    new_ahead,
)
from .story import Story
from .timeline import Timing

__all__ = [
    "CALIBRATION",
    "NOT_MEASURED",
    "Approach",
    "Control",
    "InductionLoop",
    "LoopParameters",
    "LoopState",
    "Timing",
]

FAN_W_K = 0.02  # max of what a part fan takes
HELD_BATCH_S = 0.020
PLANNED_BATCH_S = 0.010  # a measurement comes this often while material flows
AROUND_S = 0.010  # a command is no farther from the time it was meant for
DRIVE_SHARE = 0.02  # of full power: a drive is known so well
BALANCE_S = 0.1  # ten times a second is enough for a balance over half a minute

# (block, its filtered estimate or None, print time of its arrival)
BlockListener = Callable[[SampleBlock, TempEstimate | None, float], None]


class InductionLoop:
    """One nozzle. All times are print times; every verb returns the commands to send, in order of time."""

    SETTLED_C = 1.0  # "at temperature": within this of the target ...
    SETTLED_S = 0.25  # ... for this long

    def __init__(self, parameters: LoopParameters) -> None:
        self.chain = Chain()  # blocks to temperatures, with its own memory
        self.state = LoopState(law=parameters.control.law.start)
        self.parameters = parameters
        self.story = Story()
        self.listeners: list[BlockListener] = []  # given every block, in order
        self.on_listener_error: Callable[[Exception], None] = lambda problem: None
        self.on_balance: Callable[[TempEstimate, float], None] | None = (
            None  # with the heat (J) since its last call
        )
        self.quiet = True  # set from outside: neither melt nor fan takes heat
        self.flow = control_api.IDLE  # set from outside: planned extrusion, mm^3/s
        self.fan = control_api.IDLE  # set from outside: part fan, 0..1
        self.reference: control_api.Reference | None = None

    @property
    def parameters(self) -> LoopParameters:
        """In force; setting them configures the chain, too."""
        return self._parameters

    @parameters.setter
    def parameters(self, p: LoopParameters) -> None:
        self._parameters = p
        estimator = drift.corrected(p.estimator, self.state.drift.applied_c)
        self.chain.use(p.front, estimator, p.supervise, p.actuator.law, p.filter, p.has_looks)
        self._driver = driver_for(p, self.state, self.chain)
        self._drift = drift_correction(p, self.state, self.chain)

    @property
    def fault(self) -> str:
        """Text for people, "" while all is well."""
        return self.state.supervise.fault

    # The chain

    def on_blocks(self, blocks: Blocks, now_s: float) -> list[PhaseCommand]:
        """Blocks of one message, or of a batch, arrived."""
        state, before = self.state, None
        news = self.chain.take(blocks)
        self.story.note(blocks)
        if blocks.count:
            state.bridge.edge(blocks.end_s)
        if self.listeners:
            self.publish(blocks, now_s)
        if news is not None:
            before, state.estimate = state.estimate, news
            state.latency_s = now_s - news.time_s
            self._note_settled(news)
            self._watch_drive(news)
            self._note_balance(news)
        if self._drift is not None:
            self._drift.on_blocks(blocks, now_s)
        return self._step(before, now_s)

    def on_timer(self, now_s: float) -> list[PhaseCommand]:
        """Nothing came for a while; also the regular watch."""
        return self._step(None, now_s)

    def _step(self, before: TempEstimate | None, now_s: float) -> list[PhaseCommand]:
        """Safety first, then law and actuator. `before`: the estimate before the newest, None without a new one."""
        state, p = self.state, self._parameters
        blind_s, late_s = now_s - self.chain.watch.last_block_s, now_s - state.decided_s
        if state.target_c > 0.0 and late_s < math.inf:
            state.lapse_s = max(state.lapse_s, blind_s, late_s)
            supervision.watch_host(p.supervise, state.supervise, late_s)
        state.decided_s = now_s
        self._follow_reference(now_s)
        if self._watch(now_s):
            state.target_c = 0.0
            return self._driver.off(now_s)
        if blind_s > p.timing.stale_s:
            return self._driver.off(now_s)
        return self._driver.step(before, self._ahead(), now_s)

    def _watch(self, now_s: float) -> str:
        """A fault once seen stays."""
        state, p, chain = self.state, self._parameters, self.chain
        fraction = state.request.power_w / p.control.power_max_w
        temp_c, target_c, seen = state.estimate.temp_c, state.target_c, chain.watch
        supervision.watch_reading(p.supervise, state.supervise, seen, chain.witness, temp_c, target_c, p.loss)
        return supervision.watch(p.supervise, state.supervise, seen, now_s, temp_c, target_c, fraction)

    def _watch_drive(self, news: TempEstimate) -> None:
        """What the blocks say of the drive, against what was sent."""
        p, state = self._parameters, self.state
        if news.time_s - AROUND_S < state.resumed_s:
            return
        asked_w = state.bridge.strongest_w(news.time_s - AROUND_S, news.time_s + AROUND_S)
        over_w = p.actuator.law.power_w(news.phase_ticks) - asked_w - DRIVE_SHARE * p.control.power_max_w
        supervision.watch_drive(
            p.supervise, state.supervise, news.time_s, over_w, p.filter.heat.at(news.temp_c)
        )

    # Targets and parameters

    def start(self, now_s: float) -> None:
        """The bridge is off and blocks are about to come."""
        supervision.start(self.state.supervise, self.chain.watch, now_s)

    def set_target(self, target_c: float, now_s: float) -> list[PhaseCommand]:
        """New target, 0 = off; acts at once on what is known."""
        state = self.state
        if target_c == state.target_c:
            return []
        if target_c <= 0.0 or state.target_c <= 0.0:
            self._driver.switched()
        state.target_c = target_c
        self.reference = None
        state.settled_s = math.inf
        state.arriving = False
        if self._drift is not None:
            self._drift.on_target(target_c, now_s)
        if state.estimate.valid:
            return self._driver.step(state.estimate, self._ahead(), now_s, apart_s=0.0)
        return self._driver.command(now_s, apart_s=0.0)

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
        self._follow_reference(now_s)
        return []

    def _follow_reference(self, now_s: float) -> None:
        """A plan alone does not turn a heater on that is off."""
        if self.reference is not None and self.state.target_c > 0.0:
            self.state.target_c = self.reference.at(now_s)

    def _ahead(self) -> Ahead:
        return new_ahead((self.reference, self.flow, self.fan))

    def use(self, parameters: LoopParameters) -> None:
        """Go on with other parameters; another law begins with the heat that holds the nozzle as it is now."""
        p, before = self._parameters, self._parameters.control
        if (parameters.estimator, parameters.front) != (p.estimator, p.front):
            self.state.estimate = NOT_MEASURED  # another sensing law's
        self.parameters = parameters
        if parameters.control.law is not before.law:
            self._driver.take_over(self._ahead())

    def resume(self, now_s: float) -> None:
        """A calibration had the bridge: nothing remembered of the nozzle is valid."""
        self.start(now_s)
        self.state.resumed_s = now_s
        self.restart_filter()
        self.state.estimate = NOT_MEASURED
        self.state.bridge.note([PhaseCommand(now_s, 0, 0.0)], now_s)
        self.chain.samples()
        self.state.bridge.restart_actuator()
        self.state.request = NO_REQUEST

    def restart_filter(self) -> None:
        """The sensing law changed: what the filter and the balance remember is of no use."""
        self.chain.restart_filter()
        self.state.law = self._parameters.control.law.start
        self.state.heat_balance = heat_balance_monitor.HeatBalanceState()
        self.state.drift = drift.DriftMemory(is_calibrated=True)
        self.parameters = self._parameters
        self.state.warning = ""

    # Listeners and state

    def publish(self, blocks: Blocks, now_s: float, measured: bool = True) -> None:
        """Give blocks to the listeners; `measured`: with the estimates of the chain they went through.

        A listener that fails is removed and its error reported once: control goes on without it.
        """
        for i, block in enumerate(blocks):
            found = blocks.tracked(i) if measured else None
            for listener in tuple(self.listeners):
                try:
                    listener(block, found, now_s)
                except Exception as problem:
                    if listener in self.listeners:
                        self.listeners.remove(listener)
                    self.on_listener_error(problem)

    def is_settled(self) -> bool:
        """At the target, and has been for a little while."""
        state = self.state
        return state.estimate.time_s - state.settled_s >= self.SETTLED_S

    def patience_s(self) -> float:
        """Messages of blocks may come in batches of that long: off or held, and a shorter one with a change planned."""
        if self.state.target_c <= 0.0:
            return HELD_BATCH_S
        if not self._driver.PLANS or not self.state.bridge.driving or not self.is_settled():
            return 0.0
        if self.chain.watch.beyond:  # a limit: the next message decides
            return 0.0
        return HELD_BATCH_S if self._driver.is_held() else PLANNED_BATCH_S

    def _note_settled(self, news: TempEstimate) -> None:
        state = self.state
        below_c = state.target_c - news.temp_c
        cycle_c = self._parameters.control.cycle_c
        if below_c > cycle_c if cycle_c else abs(below_c) > self.SETTLED_C:
            state.settled_s = math.inf
        elif state.settled_s == math.inf:
            state.settled_s = news.time_s

    def _note_balance(self, news: TempEstimate) -> None:
        state, p = self.state, self._parameters
        if news.time_s - state.balanced_s < BALANCE_S or not p.supervise.calibrated:
            return
        heat_j = self.chain.take_heat_j()
        if self._drift is not None:
            self._drift.on_balance(news, heat_j)
        heat_balance_monitor.observe(
            p.heat_balance, state.heat_balance, news.time_s, news.temp_c, heat_j, self.quiet
        )
        if self.on_balance is not None:
            try:
                self.on_balance(news, heat_j)
            except Exception as problem:
                self.on_balance = None
                self.on_listener_error(problem)
        self._inform_witness(news)
        state.balanced_s = news.time_s
        state.warning = heat_balance_monitor.warning(p.heat_balance, state.heat_balance) or drift.warning(
            state.drift
        )

    def _inform_witness(self, news: TempEstimate) -> None:
        """What the heat witness may assume from now on."""
        p, inputs = self._parameters, self.chain.witness.inputs
        near_s = (news.time_s - BALANCE_S, news.time_s, news.time_s + BALANCE_S)
        taken_w = (
            max(map(self.flow.at, near_s))
            * p.melt.heat_mj_m3k
            * 1e-3
            * max(0.0, news.temp_c - p.melt.inlet_c)
        )
        taken_w += max(map(self.fan.at, near_s)) * FAN_W_K * max(0.0, news.temp_c - p.loss.ambient_c)
        exact = isinstance(p.estimator.law, laws.TankLaw)
        supervision.inform(p.supervise, p.heat_balance, self.state.heat_balance, inputs, taken_w, exact)
        holds = p.control.law.name != CALIBRATION  # a run has no target to hold
        inputs.room_c = p.supervise.above_target_c + p.control.beyond_c if holds else 0.0
