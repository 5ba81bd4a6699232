"""Predictive control written out in Python, as an independent reference for the one in C.

From the docstring of thermal/control/predictive.py; filter and plant have files of their own.
"""

from __future__ import annotations

import math

from reference.model_reference_filter import ModelState, observe, taken_over
from reference.model_reference_plant import (
    advance,
    changes,
    heat_per_output_w,
    hold_w,
    is_flat,
    reference_at,
    schedule_at,
)
from thermal.control.control_api import ControlInput, ControlOutput, Reference
from thermal.models.heater_model import ModelParameters, Nodes
from thermal.records import Planned, Sample

SAME_SHARE = 0.004  # outputs nearer than this (of full output) are one and the same step
SETTLED_C = 0.25  # nearer than this to the reference, and not about to change: no horizon is worth sending
SINGLE_STEPS = 6  # of the plan; the later ones are twice as long
PIECE_S = 0.02  # flow and fan are looked at so often
TEMP = Nodes._fields.index("temp_c")
SETTLED_MM3_S = 0.2  # the flow at the nozzle still follows that of the motor when farther from it than this


# The mean of a reading that swings.
RIDDEN_C, RIDDEN_AFTER_S, RIDDEN_SWINGS, RIDDEN_NEAR_C = 0.5, 2.0, 6.0, 10.0
RIDDEN_S, RIDDEN_MAX_C = 1.0, 4.0


def _wanted(inputs: ControlInput, time_s: float) -> float:
    return inputs.reference_c if inputs.reference is None else reference_at(inputs.reference, time_s)


def _target(
    p: ModelParameters, inputs: ControlInput, temp_c: float, time_s: float, dt_s: float, remaining: float
) -> float:
    """Temperature in degC the controlled node shall have at `time_s + dt_s`; `remaining`: what is left by then."""
    if inputs.reference is None:
        now_c = then_c = inputs.reference_c
    else:
        now_c, then_c = reference_at(inputs.reference, time_s), reference_at(inputs.reference, time_s + dt_s)
    return then_c - min(p.band_c, max(-p.band_c, now_c - temp_c)) * remaining


def _ridden(p: ModelParameters, state: ModelState, inputs: ControlInput) -> ModelState:
    """With what is added to the wanted temperature while the reading swings."""
    share = min(1.0, state.read_s / RIDDEN_S)
    now_c = _wanted(inputs, state.time_s)
    swings = p.coloured_c2_s > 0.0 and state.swing_c >= RIDDEN_C
    is_near = abs(now_c - state.nodes.temp_c) <= min(RIDDEN_NEAR_C, RIDDEN_SWINGS * state.swing_c)
    swinging_s, ridden_c = state.swinging_s + state.read_s if swings and is_near else 0.0, state.ridden_c
    if not swings:
        ridden_c -= share * ridden_c
    elif swinging_s >= RIDDEN_AFTER_S:
        ridden_c = min(
            RIDDEN_MAX_C, max(-RIDDEN_MAX_C, ridden_c + (now_c * state.read_s - state.read_cs) / RIDDEN_S)
        )
    return state._replace(swinging_s=swinging_s, ridden_c=ridden_c)


def _shifted(inputs: ControlInput, by_c: float) -> ControlInput:
    line = inputs.reference
    if line is None:
        return inputs._replace(reference_c=inputs.reference_c + by_c)
    return inputs._replace(reference=Reference(line.times_s, tuple(c + by_c for c in line.temps_c)))


class _Future:
    """The model run ahead from one state; output units."""

    def __init__(self, p: ModelParameters, state: ModelState, inputs: ControlInput, time_s: float) -> None:
        self.p, self.inputs = p, inputs
        self.gain, self.disturbance_w = state.gain, state.disturbance_w
        self.nodes: Nodes = state.nodes
        self.time_s = time_s
        self.without = self.reached = self.nodes  # one horizon on, with no output and with full output

    def run(self, nodes: Nodes, output: float, start_s: float, dt_s: float) -> Nodes:
        """The nodes after `dt_s` of one output. Surroundings are taken at the middle of each piece."""
        longest_s = max(self.p.hold_s, PIECE_S)
        pieces = 1 if dt_s <= longest_s else math.ceil(dt_s / longest_s - 1e-6)
        piece_s = dt_s / pieces
        drive = output, self.gain, self.disturbance_w
        flow, fan = self.inputs.flow_mm3_s, self.inputs.fan
        for i in range(pieces):
            middle_s = start_s + (i + 0.5) * piece_s
            nodes = advance(
                self.p, nodes, drive, (schedule_at(flow, middle_s), schedule_at(fan, middle_s)), piece_s
            )
        return nodes

    def follow(self, outputs: tuple[Planned, ...], before: float, until_s: float) -> None:
        """Move on through outputs already decided."""
        output = before
        for planned in outputs:
            at_s = min(max(planned.time_s, self.time_s), until_s)
            self.hold(output, at_s - self.time_s)
            output = planned.value
        self.hold(output, until_s - self.time_s)

    def hold(self, output: float, dt_s: float) -> None:
        if dt_s > 0.0:
            self.nodes = self.run(self.nodes, output, self.time_s, dt_s)
            self.time_s += dt_s

    def choose(self, full: float) -> float:
        """Unlimited output from now on."""
        p = self.p
        target_c = _target(p, self.inputs, self.nodes.temp_c, self.time_s, p.prediction_s, p.remaining)
        self.without = self.run(self.nodes, 0.0, self.time_s, p.prediction_s)
        self.reached = self.run(self.nodes, full, self.time_s, p.prediction_s)
        reach_c = self.reached.temp_c - self.without.temp_c
        return full * (target_c - self.without.temp_c) / reach_c if reach_c > 1e-9 else 0.0


def _limited(p: ModelParameters, inputs: ControlInput, value: float, before: float, hold_s: float) -> float:
    """Within the power's range, the step's limit and the slew rate."""
    step = p.slew_per_s * hold_s
    high = min(p.output_high, inputs.limit, before + step)
    return max(0.0, before - step, min(high, value))


def _plan(p: ModelParameters, future: _Future, first: float) -> tuple[Planned, ...]:
    """What follows the first output, as far as it differs; ends holding the wanted temperature."""
    inputs, horizon, output, said = future.inputs, [], first, first
    same, full = SAME_SHARE * p.output_high, p.output_high
    added = [(b - a) / full for a, b in zip(future.without, future.reached, strict=True)]
    reach_c = max(added[TEMP], 1e-12)
    future.hold(output, p.prediction_s)
    for steps in _lengths(p.ahead):
        start_s, start_c, dt_s = future.time_s, future.nodes.temp_c, steps * p.prediction_s
        target_c = _target(p, inputs, start_c, start_s, dt_s, p.remaining**steps)
        future.hold(output, dt_s)
        wanted = output + (target_c - future.nodes.temp_c) / (steps * reach_c)
        change = _limited(p, inputs, wanted, output, p.prediction_s) - output
        if change:
            output += change
            change *= steps
            future.nodes = Nodes(*[n + change * a for n, a in zip(future.nodes, added, strict=True)])
        if abs(output - said) > same:
            horizon.append(Planned(start_s, output))
            said = output
    end_s = future.time_s
    wanted_c = _wanted(inputs, end_s)
    power_w = (
        hold_w(p, wanted_c, schedule_at(inputs.flow_mm3_s, end_s), schedule_at(inputs.fan, end_s))
        - future.disturbance_w
    )
    holding = max(0.0, power_w / (heat_per_output_w(p, wanted_c) * future.gain))
    if said > holding + 0.05 * full:
        horizon.append(Planned(end_s, min(holding, said)))
    return tuple(horizon)


def _lengths(ahead: int) -> tuple[int, ...]:
    """Of the steps of a plan in strides, `ahead` of them in all: the later ones are likely to be replaced."""
    doubles = max(0, ahead - SINGLE_STEPS + 1) // 2
    return (1,) * (ahead - 2 * doubles) + (2,) * doubles


def _is_unchanging(p: ModelParameters, future: _Future) -> bool:
    """Nothing is going to happen within the horizon that a single output does not do."""
    inputs = future.inputs
    now_s, end_s = future.time_s, future.time_s + (p.ahead + 1) * p.prediction_s
    if abs(_wanted(inputs, now_s) - future.nodes.temp_c) >= SETTLED_C:
        return False
    if inputs.reference is not None and not is_flat(inputs.reference, now_s, end_s):
        return False
    if abs(schedule_at(inputs.flow_mm3_s, now_s) - future.nodes.flow) >= SETTLED_MM3_S:
        return False
    return not (changes(inputs.flow_mm3_s, now_s, end_s) or changes(inputs.fan, now_s, end_s))


def _samples(
    p: ModelParameters, state: ModelState, inputs: ControlInput, time_s: float
) -> tuple[Sample, ...]:
    """The step's measurements; a single one without more ado is wrapped."""
    if inputs.samples:
        return inputs.samples
    sigma_c = inputs.sigma_c if inputs.sigma_c > 0.0 else 0.0
    if inputs.applied == inputs.applied:
        return (Sample(time_s, time_s, inputs.measured_c, sigma_c, inputs.applied, inputs.rebased),)
    samples, output = [], state.output if not state.sent else state.sent[0].value
    for planned in state.sent:
        if planned.time_s >= time_s:
            break
        if planned.time_s > state.time_s:
            samples.append(Sample(planned.time_s, planned.time_s, math.nan, 0.0, output))
        output = planned.value
    samples.append(Sample(time_s, time_s, inputs.measured_c, sigma_c, output, inputs.rebased))
    return tuple(samples)


def _remembered(state: ModelState, time_s: float, new: Planned) -> tuple[Planned, ...]:
    """Own outputs that still matter: the one in force at `time_s` and all later ones."""
    sent = (*state.sent, new)
    start = 0
    for i, planned in enumerate(sent):
        if planned.time_s <= time_s:
            start = i
    return sent[start:]


def model_step(
    p: ModelParameters, state: ModelState, inputs: ControlInput, time_s: float
) -> tuple[ControlOutput, ModelState]:
    """One step with the measurements up to `time_s`; the output is meant from apply_s on."""
    samples = _samples(p, state, inputs, time_s)
    state = observe(p, state, samples, inputs.flow_mm3_s, inputs.fan)
    apply_s = inputs.apply_s if inputs.apply_s == inputs.apply_s else time_s + p.delay_s
    own = inputs.pending is None
    if not state.known or inputs.reference_c <= 0.0:
        off = Planned(apply_s, 0.0)
        sent = _remembered(state, time_s, off) if own else ()
        return ControlOutput(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), state._replace(output=0.0, sent=sent)
    state = _ridden(p, state, inputs)
    inputs = _shifted(inputs, state.ridden_c)
    future = _Future(p, state, inputs, state.time_s)
    future.follow(state.sent if inputs.pending is None else inputs.pending, samples[-1].output, apply_s)
    at = future.nodes
    unlimited = future.choose(p.output_high)
    value = _limited(p, inputs, unlimited, state.output, p.hold_s)
    steady = not p.ahead or _is_unchanging(p, future)
    horizon = () if steady else _plan(p, future, value)
    per_output_w = heat_per_output_w(p, at.temp_c) * state.gain
    flow, fan = schedule_at(inputs.flow_mm3_s, apply_s), schedule_at(inputs.fan, apply_s)
    loss = hold_w(p, at.temp_c, flow, fan) / per_output_w
    learned = -state.disturbance_w / per_output_w
    output = ControlOutput(
        value, unlimited, unlimited - loss - learned, learned, 0.0, loss, at.temp_c, horizon
    )
    sent = _remembered(state, time_s, Planned(apply_s, value)) if own else ()
    return output, state._replace(output=value, sent=sent)


def model_follow(p: ModelParameters, state: ModelState, inputs: ControlInput, output: float) -> ModelState:
    """Somebody else's output: noted, so that prediction and slew rate start from it.

    A filter that knows nothing yet begins at the newest of `inputs.samples`, with `output` as what holds it there.
    """
    if state.known or not inputs.samples:
        return state._replace(output=output)
    seen = inputs.samples[-1]
    flow, fan = schedule_at(inputs.flow_mm3_s, seen.end_s), schedule_at(inputs.fan, seen.end_s)
    expected_w = hold_w(p, seen.temp_c, flow, fan)
    unknown_w = expected_w - output * heat_per_output_w(p, seen.temp_c)
    state = taken_over(p, observe(p, state, (seen,)), unknown_w)
    return state._replace(output=seen.output)
