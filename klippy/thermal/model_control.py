"""`control: model`: what the filter knows, carried forward to when an output holds, and the output that fits.

    samples ─► observe (model_filter) ─► state at time_s ─► predict through what is pending ─► state at apply_s
                                                                                             │
         reference, flow, fan ahead ──────────────────────────────────────────────────► choose ─► output, horizon

Prediction takes the delays out: measuring, link, command lead and heater element are behind us when the choice
is made. The choice is one number u for the time from t on: with u held the controlled node shall be at
`aim` a horizon H later. The model is linear in u as near as matters, so two runs (u = 0 and u = most) give it:

    T(t+H | u) = T0 + u/most (T1 - T0)  =  aim        aim = r(t+H) - e(H)

    e(H) = e exp(-H/fade) for small deviations e = r - T;  no more than the knee's for large ones

so a large deviation is run down at the limit of the power and its last degrees fade. Losses, fan, melt of the
planned flow and the learned disturbance are in T0: that is the feed-forward. Limits are exact: the output is
cut to 0..most, to the step's limit, to the slew rate, and the next choice starts from what will be, not from
what was wished. Nothing is integrated but the disturbance, in the filter: nothing winds up.

The horizon: the same choice again from the predicted state, `ahead` times, should the host be late.
"""

from __future__ import annotations

import math

from .control_api import ControlInput, ControlOutput, Law, Planned, Sample
from .model_filter import ModelState, observe, taken_over
from .model_plant import ModelParameters, Nodes, advance, heat_per_output_w, hold_w

__all__ = ["MODEL", "ModelParameters", "ModelState", "model_follow", "model_step"]

SAME_SHARE = 0.004  # outputs nearer than this (of the most) are one and the same step
SETTLED_C = 0.25  # nearer than this to the reference, and not about to change: no horizon is worth sending


def _wanted(inputs: ControlInput, time_s: float) -> float:
    return inputs.reference_c if inputs.reference is None else inputs.reference.at(time_s)


def _aim(p: ModelParameters, inputs: ControlInput, temp_c: float, time_s: float, horizon_s: float) -> float:
    """Temperature the controlled node shall have at `time_s + horizon_s`."""
    deviation_c = _wanted(inputs, time_s) - temp_c
    small_c = min(p.knee_c, max(-p.knee_c, deviation_c))
    fade = math.exp(-horizon_s / p.fade_s) if p.fade_s > 0.0 else 0.0
    return _wanted(inputs, time_s + horizon_s) - small_c * fade


class _Future:
    """The model run ahead from one state; output units."""

    def __init__(self, p: ModelParameters, state: ModelState, inputs: ControlInput, time_s: float) -> None:
        self.p, self.inputs = p, inputs
        self.gain, self.disturbance_w = state.gain, state.disturbance_w
        self.nodes: Nodes = state.nodes
        self.time_s = time_s

    def run(self, nodes: Nodes, output: float, start_s: float, dt_s: float) -> Nodes:
        """The nodes after `dt_s` of one output. Surroundings are taken at the middle of each piece."""
        pieces = max(1, math.ceil(dt_s / max(self.p.hold_s, 0.02) - 1e-6))
        piece_s = dt_s / pieces
        drive = output, self.gain, self.disturbance_w
        for i in range(pieces):
            middle_s = start_s + (i + 0.5) * piece_s
            surroundings = self.inputs.flow_mm3_s.at(middle_s), self.inputs.fan.at(middle_s)
            nodes = advance(self.p, nodes, drive, surroundings, piece_s)
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

    def choose(self, most: float) -> float:
        """Unlimited output from now on."""
        p = self.p
        horizon_s = max(p.hold_s, p.horizon_s)
        aim_c = _aim(p, self.inputs, self.nodes.temp_c, self.time_s, horizon_s)
        without_c = self.run(self.nodes, 0.0, self.time_s, horizon_s).temp_c
        reach_c = self.run(self.nodes, most, self.time_s, horizon_s).temp_c - without_c
        return most * (aim_c - without_c) / reach_c if reach_c > 1e-9 else 0.0


def _limited(p: ModelParameters, inputs: ControlInput, value: float, before: float, hold_s: float) -> float:
    """Within the power's range, the step's limit and the slew rate."""
    step = p.slew_per_s * hold_s
    high = min(p.output_high, inputs.limit, before + step)
    return max(0.0, before - step, min(high, value))


def _plan(p: ModelParameters, future: _Future, first: float, hold_s: float) -> tuple[Planned, ...]:
    """What follows the first output, as far as it differs; ends holding the wanted temperature."""
    inputs, horizon, output = future.inputs, [], first
    same = SAME_SHARE * p.output_high
    for _ in range(p.ahead):
        future.hold(output, hold_s)
        wanted = _limited(p, inputs, future.choose(p.output_high), output, hold_s)
        if abs(wanted - output) > same:
            horizon.append(Planned(future.time_s, wanted))
            output = wanted
    end_s = future.time_s + hold_s
    wanted_c = _wanted(inputs, end_s)
    power_w = hold_w(p, wanted_c, inputs.flow_mm3_s.at(end_s), inputs.fan.at(end_s)) - future.disturbance_w
    holding = max(0.0, power_w / (heat_per_output_w(p, wanted_c) * future.gain))
    if output > holding + 0.05 * p.output_high:
        horizon.append(Planned(end_s, min(holding, output)))
    return tuple(horizon)


def _is_calm(p: ModelParameters, future: _Future, first: float) -> bool:
    """Nothing is going to happen within the horizon that a single output does not do."""
    inputs = future.inputs
    now_s, end_s = future.time_s, future.time_s + p.ahead * p.hold_s
    near = abs(_wanted(inputs, now_s) - future.nodes.temp_c) < SETTLED_C
    flat = inputs.reference is None or _wanted(inputs, now_s) == _wanted(inputs, end_s)
    return near and flat and inputs.flow_mm3_s.at(now_s) == inputs.flow_mm3_s.at(end_s)


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
    hold_s = inputs.hold_s if inputs.hold_s == inputs.hold_s else p.hold_s
    own = inputs.pending is None
    if not state.known or inputs.reference_c <= 0.0:
        off = Planned(apply_s, 0.0)
        sent = _remembered(state, time_s, off) if own else ()
        return ControlOutput(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), state._replace(output=0.0, sent=sent)
    future = _Future(p, state, inputs, state.time_s)
    future.follow(state.sent if inputs.pending is None else inputs.pending, samples[-1].output, apply_s)
    at = future.nodes
    unlimited = future.choose(p.output_high)
    value = _limited(p, inputs, unlimited, state.output, hold_s)
    calm = not p.ahead or _is_calm(p, future, value)
    horizon = () if calm else _plan(p, future, value, hold_s)
    per_output_w = heat_per_output_w(p, at.temp_c) * state.gain
    loss = hold_w(p, at.temp_c, inputs.flow_mm3_s.at(apply_s), inputs.fan.at(apply_s)) / per_output_w
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
    flow, fan = inputs.flow_mm3_s.at(seen.end_s), inputs.fan.at(seen.end_s)
    expected_w = hold_w(p, seen.temp_c, flow, fan)
    unknown_w = expected_w - output * heat_per_output_w(p, seen.temp_c)
    state = taken_over(p, observe(p, state, (seen,)), unknown_w)
    return state._replace(output=seen.output)


MODEL: Law[ModelParameters, ModelState] = Law("model", model_step, ModelState(), model_follow)
