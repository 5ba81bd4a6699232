"""The loop's side of thermal/drift/correction.py: gives it blocks, heat and looks, and lets the chain follow."""

from __future__ import annotations

import math

from thermal.drift import correction as drift
from thermal.drift import observer as drift_observer
from thermal.drift.observer import DriftParameters
from thermal.records import TempEstimate
from thermal.sensing.blocks import Blocks
from thermal.sensing.laws import TankLaw
from thermal.sensing.pipeline import Chain

from . import predictive
from .loop_records import LoopParameters, LoopState

SMALL_C = 0.01  # a smaller step of the correction is not worth it


class DriftCorrection:
    """One nozzle's, with a calibrated tank law."""

    def __init__(
        self, parameters: LoopParameters, known: DriftParameters, state: LoopState, chain: Chain
    ) -> None:
        self.parameters, self.known, self.state, self.chain = parameters, known, state, chain

    def on_blocks(self, blocks: Blocks, now_s: float) -> None:
        """Blocks that went through the chain. While the heater is off they show the nozzle at rest."""
        p, state, m = self.parameters, self.state, self.state.drift
        if m.is_on and state.target_c > 0.0 and not state.is_waiting:
            return
        drift.advance(self.known, m, now_s, 0.0)
        drift.note_target(m, state.target_c > 0.0, now_s)
        drift.note_rest(m, p.estimator, blocks)
        if drift.zero(self.known, m, p.heat_balance, now_s):
            self._follow(math.inf)
        self._begin(now_s)
        if drift.is_detuned(m, p.supervise.temp_low_c):
            self.chain.watch.beyond = 0  # no heat goes in, and the zero is yet to come

    def on_target(self, target_c: float, now_s: float) -> None:
        """A new target, before the law acts on it."""
        m = self.state.drift
        if not drift.note_target(m, target_c > 0.0, now_s):
            return
        self._begin(now_s)

    def _begin(self, now_s: float) -> None:
        """Heat may go in, or waits for the zero."""
        m = self.state.drift
        self.state.is_waiting = drift.waits(self.known, m, now_s)
        if m.is_on and not self.state.is_waiting:
            drift.glance(self.known, m)
            self._follow(math.inf)

    def on_balance(self, news: TempEstimate, heat_j: float) -> None:
        """Ten times a second; `heat_j` put in since the last time."""
        p, state, m = self.parameters, self.state, self.state.drift
        drift.advance(self.known, m, news.time_s, heat_j)
        drift.note_looks(
            self.known, m, p.estimator, self.chain.state.drive, news.temp_c, p.front.phase_max_ticks
        )
        drift.note_balance(m, state.heat_balance.drift_c)
        self.chain.set_doubt(m.state.sigma_c)
        if m.is_on:
            self._follow(state.target_c - news.temp_c)

    def _follow(self, below_c: float) -> None:
        p, m, law = self.parameters, self.state.drift, self.parameters.estimator.law
        before_c, after_c = m.applied_c, drift.follow(m, 0.1, below_c)
        if abs(after_c - before_c) < SMALL_C or not isinstance(law, TankLaw):
            return
        m.applied_c = after_c
        temp_c = self.state.estimate.temp_c if self.state.estimate.valid else self.known.room_c
        off = [before_c, *[0.0] * (drift_observer.COUNT - 1)]
        full, low = p.front.phase_max_ticks, p.estimator.phase_low_ticks
        added_c = drift_observer.added_c(law, after_c, off, temp_c, full, low, p.estimator.supply)
        moved_c = before_c - after_c
        self.chain.correct(drift.corrected(p.estimator, after_c), moved_c, added_c)
        memory = self.state.law
        if isinstance(memory, predictive.ModelState) and not math.isnan(memory.raw.time_s):
            nodes = memory.raw.nodes
            for name in ("element_c", "temp_c", "sensor_c", "bore_c"):
                setattr(nodes, name, getattr(nodes, name) + moved_c)


def drift_correction(parameters: LoopParameters, state: LoopState, chain: Chain) -> DriftCorrection | None:
    """None: the law stays as it is."""
    known = parameters.drift
    return (
        DriftCorrection(parameters, known, state, chain)
        if known is not None and parameters.has_looks
        else None
    )
