"""What all identification runs share: a run decides and records, the host's runner (extras/heater/run.py) acts.

    sweep      blocks in, phase commands out: it commands the bridge itself
    relay      an OutputRun: readings in, output out
    step_test  an OutputRun, too

The runner feeds a run until it is `over`, then has it `write` its trace. `abort` ends it at any time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import TextIO

from thermal.control import control_api, loop
from thermal.records import Sample

DONE, FAILED = "done", "failed"  # how a run ends


class Run:
    """One run; after FAILED, `fault` has the reason for people."""

    poll_s = 0.1  # how often the runner looks at it ...
    progress_s = 10.0  # ... and reports its progress
    timeout_s = 10.0  # it ends after this time without a reading

    def __init__(self, stage: str) -> None:
        self.stage = stage
        self.fault = ""

    @property
    def over(self) -> bool:
        return self.stage in (DONE, FAILED)

    def abort(self, reason: str) -> None:
        if not self.over:
            self.stage, self.fault = FAILED, reason

    def progress(self, temp_c: float) -> str:
        """For people; `temp_c`: the heater's newest reading."""
        raise NotImplementedError

    def write(self, stream: TextIO) -> None:
        """The trace, as text."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class OutputPlan:
    """What every OutputRun is given. Times in s, outputs in the heater's unit (duty or W)."""

    target_c: float
    high: float
    band_c: float  # on-off about the target
    _: KW_ONLY
    heat_s: float = 1200.0  # longest way to the target
    lost_c: float = 40.0  # farther above the target than this the run ends
    gain_c: float = 3.0  # at full power it must warm by this ...
    gain_s: float = 90.0  # ... within this time


class OutputRun(Run):
    """A run that is asked for the output at every reading."""

    def __init__(self, plan: OutputPlan, stage: str) -> None:
        super().__init__(stage)
        self.plan = plan
        self._gain = (math.nan, math.nan)

    @property
    def target_c(self) -> float:
        raise NotImplementedError

    def decide(self, time_s: float, temp_c: float, limit: float = math.inf) -> float:
        """Output from now on; `temp_c` NaN: no reading."""
        raise NotImplementedError

    def take_samples(self, samples: Sequence[Sample], flow: control_api.Schedule) -> None:
        """An induction nozzle's samples, and what its extruder does."""

    def _check_heating(self, time_s: float, temp_c: float, full: bool) -> None:
        """Ends the run if full power does not warm, or if the heater does not turn off."""
        plan = self.plan
        start_s, start_c = self._gain
        if not full or not temp_c < start_c + plan.gain_c or temp_c > plan.target_c:
            self._gain = time_s, temp_c
        elif time_s - start_s > plan.gain_s:
            self.abort(
                f"the temperature went from {start_c:.1f} to {temp_c:.1f} C in {plan.gain_s:.0f} s of heating: heater"
                " or sensor is broken, or they are not on the same part"
            )
        if temp_c > plan.target_c + plan.lost_c:
            self.abort(
                f"{temp_c:.0f} C is {plan.lost_c:.0f} C above the target: the heater does not turn off"
            )


def as_control(run: OutputRun, power_max_w: float) -> loop.Control:
    """The run as the control law of an induction nozzle: sensing, limits and supervision stay as they are."""

    def step(
        parameters: None, state: int, inputs: control_api.ControlInput, time_s: float
    ) -> tuple[control_api.ControlOutput, int]:
        run.take_samples(inputs.samples, inputs.flow_mm3_s)
        seen = [s for s in inputs.samples if s.temp_c == s.temp_c and not s.rebased]
        temp_c = math.fsum(s.temp_c for s in seen) / len(seen) if seen else math.nan
        at_s = math.fsum(s.time_s for s in seen) / len(seen) if seen else time_s
        limit_w = min(power_max_w, inputs.limit)
        power_w = max(0.0, min(limit_w, run.decide(at_s, temp_c, limit_w)))
        return control_api.ControlOutput(power_w, power_w, power_w, 0.0, 0.0, 0.0), state

    law = control_api.Law(loop.CALIBRATION, step, 0, lambda p, state, inputs, out: state)
    return loop.Control(law, None, power_max_w, models=True)
