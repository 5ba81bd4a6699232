"""The run of MODEL_CALIBRATE: heat, hold, (fan), (flow), cool, and a second pulse the fit is not shown.

An induction nozzle may after the hold be held at further temperatures and flows (`further`).

    degC      ┌╲╱╲╱╲╱ hold ╲╱╲ fan ╲╱╲ flow ╲          target, switched on and off around it (the swing gives the lags)
             ╱                                ╲  cool    ╱╲      validate: full power half way back, then nothing
    ────────╱ heat                             ╲───────╱   ╲──

Output is duty or watts; what is recorded is the mean output that was in force between two readings.
"""

from __future__ import annotations

import csv
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TextIO

from thermal.control.control_api import Schedule
from thermal.records import Sample

from .run import DONE, OutputPlan, OutputRun

STAGES = ("heat", "hold", "fan", "flow", "cool", "validate", "coast")


class Step(NamedTuple):
    """Held at a temperature while it extrudes; the climb or fall to it counts."""

    stage: str
    target_c: float
    flow_mm3_s: float
    lasts_s: float


MELT = "melt"  # how the names of these steps begin
MELT_PROOF = "melt proof"  # the fit is not shown this one


def melt_steps(hot_c: float, cool_c: float, flow_mm3_s: float) -> tuple[Step, ...]:
    """Steps that measure what filament takes (fit_melt.py): three flows up to `flow_mm3_s`, two temperatures.

    The fast ones come hot, where the melt flows easily; each rest is the loss beside which the others are judged.
    """
    slow, middle, proof = 0.2 * flow_mm3_s, 0.5 * flow_mm3_s, 0.35 * flow_mm3_s
    return (
        Step("melt slow, hot", hot_c, slow, 5.0),
        Step("melt fast, hot", hot_c, flow_mm3_s, 5.0),
        Step("melt middle, hot", hot_c, middle, 5.0),
        Step("melt middle, cool", cool_c, middle, 7.5),
        Step("melt slow, cool", cool_c, slow, 5.0),
        Step(MELT_PROOF, cool_c, proof, 5.0),
        Step("melt rest, cool", cool_c, 0.0, 5.0),
    )


class Row(NamedTuple):
    """One reading (NaN: none) and what was in force since the row before."""

    time_s: float
    temp_c: float
    output: float
    fan: float
    flow_mm3_s: float
    stage: str


@dataclass(frozen=True, slots=True)
class StepTestPlan(OutputPlan):
    """How to heat, hold and cool."""

    delay_s: float  # reading to output in force
    hold_s: float
    cool_s: float
    coast_s: float
    fan_s: float = 0.0  # 0: no fan step
    flow_s: float = 0.0  # 0: no flow step
    flow_mm3_s: float = 0.0
    further: tuple[Step, ...] = ()  # after the hold
    even_c: float = 0.0  # hold with a drive proportional over this band instead of on and off
    share: float = 0.6  # hold and cool last at least this share of the heating
    cool_to: float = 0.45  # cooling ends at this share of the rise; the pulse goes half way back


class StepTest(OutputRun):
    """One run."""

    plan: StepTestPlan

    def __init__(self, plan: StepTestPlan, start_c: float) -> None:
        super().__init__(plan, "heat")
        self.start_c = start_c
        self.rows: list[Row] = []
        self.heated_s = 0.0
        self._share = 1.0  # of the output
        self._pulse_rise = 0.0  # where the present stage began, share of the rise
        self._begun_s = math.nan  # of the stage
        self._decided: list[tuple[float, float]] = []  # (time in force from, output), own decisions
        self._is_sampled = False  # induction: samples make the rows
        self._steps = deque(plan.further)
        self._step: Step | None = None  # under way

    @property
    def target_c(self) -> float:
        if self._step is not None:
            return 0.0 if self.over else self._step.target_c
        return self.plan.target_c if self.stage in ("heat", "hold", "fan", "flow", "validate") else 0.0

    @property
    def fan(self) -> float:
        """Part fan wanted, 0..1."""
        return 1.0 if self.stage == "fan" else 0.0

    @property
    def flow_mm3_s(self) -> float:
        """Extrusion wanted."""
        if self._step is not None:
            return 0.0 if self.over else self._step.flow_mm3_s
        return self.plan.flow_mm3_s if self.stage == "flow" else 0.0

    def progress(self, temp_c: float) -> str:
        doing = {"heat": "heating", "hold": "holding", "cool": "cooling"}.get(self.stage, self.stage)
        return f"{doing}, {temp_c:.1f} C"

    def write(self, stream: TextIO) -> None:
        writer = csv.writer(stream)
        writer.writerow(Row._fields)
        writer.writerows(self.rows)

    def decide(self, time_s: float, temp_c: float, limit: float = math.inf) -> float:
        if self.over:
            return 0.0
        if not math.isnan(temp_c):
            if math.isnan(self._begun_s):
                self._begun_s = time_s
            self._check(time_s, temp_c)
            self._advance(time_s, temp_c)
            if not self._is_sampled:
                self._note(time_s, temp_c)
        output = min(limit, self.plan.high * self._share) if not self.over else 0.0
        self._decided.append((time_s + self.plan.delay_s, output))
        return output

    def take_samples(self, samples: Sequence[Sample], flow: Schedule) -> None:
        """Each sample has the heat in force itself, the extruder's queue the flow."""
        self._is_sampled = self._is_sampled or bool(samples)
        for sample in samples:
            temp_c = math.nan if sample.rebased else sample.temp_c
            flow_mm3_s = flow.at(sample.time_s)
            self.rows.append(Row(sample.time_s, temp_c, sample.output, self.fan, flow_mm3_s, self.stage))

    def _note(self, time_s: float, temp_c: float) -> None:
        since_s = self.rows[-1].time_s if self.rows else time_s
        mean = self._mean_output(since_s, time_s)
        self.rows.append(Row(time_s, temp_c, mean, self.fan, self.flow_mm3_s, self.stage))

    def _mean_output(self, start_s: float, end_s: float) -> float:
        """Mean of the own decisions in force in between."""
        if end_s <= start_s:
            return 0.0
        total, output, at_s = 0.0, 0.0, start_s
        kept = 0
        for i, (from_s, value) in enumerate(self._decided):
            if from_s >= end_s:
                break
            total += output * max(0.0, from_s - at_s)
            at_s, output, kept = max(at_s, from_s), value, i
        del self._decided[:kept]
        return (total + output * (end_s - at_s)) / (end_s - start_s)

    def _check(self, time_s: float, temp_c: float) -> None:
        self._check_heating(time_s, temp_c, self._share >= 1.0)
        if self.stage == "heat" and time_s - self._begun_s > self.plan.heat_s:
            self.abort(f"the target was not reached within {self.plan.heat_s:.0f} s ({temp_c:.1f} C)")

    def lasts_s(self) -> float:
        """How long the present stage lasts, s; heat and validate end by temperature."""
        plan, share_s = self.plan, self.plan.share * self.heated_s
        if self._step is not None:
            return self._step.lasts_s
        return {
            "hold": max(plan.hold_s, share_s),
            "fan": plan.fan_s,
            "flow": plan.flow_s,
            "cool": max(plan.cool_s, share_s),
            "validate": max(60.0, self.heated_s),
            "coast": plan.coast_s,
        }.get(self.stage, math.inf)

    def _advance(self, time_s: float, temp_c: float) -> None:
        plan = self.plan
        if self.over:
            return
        rise = (temp_c - self.start_c) / (plan.target_c - self.start_c)
        ended = time_s - self._begun_s >= self.lasts_s()
        if self.stage == "heat" and rise >= 1.0:
            self.heated_s, ended = time_s - self._begun_s, True
        ended = ended or (self.stage == "cool" and rise <= plan.cool_to)
        ended = ended or (self.stage == "validate" and rise >= 0.5 * (self._pulse_rise + 1.0))
        if ended:
            self._pulse_rise = rise
            self._next(time_s)
        held = self._step is not None or self.stage in ("hold", "fan", "flow")
        if held and plan.even_c:
            self._share = min(1.0, max(0.0, 0.5 + (self.target_c - temp_c) / plan.even_c))
        elif held:
            if temp_c >= plan.target_c + plan.band_c:
                self._share = 0.0
            elif temp_c <= plan.target_c - plan.band_c:
                self._share = 1.0
        else:
            self._share = float(self.stage in ("heat", "validate"))

    def _next(self, time_s: float) -> None:
        self._begun_s = time_s
        if self._steps and (self.stage == "hold" or self._step is not None):
            self._step = self._steps.popleft()
            self.stage = self._step.stage
            return
        skipped = {name for name, s in (("fan", self.plan.fan_s), ("flow", self.plan.flow_s)) if s <= 0.0}
        passed = STAGES.index("hold" if self._step is not None else self.stage) + 1
        later = [name for name in STAGES[passed:] if name not in skipped]
        self._step = None
        self.stage = later[0] if later else DONE
