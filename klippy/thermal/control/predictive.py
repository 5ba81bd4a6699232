"""`control: model`: what the filter knows, carried forward to when an output holds, and the output that fits.

    samples ─► observe (model_filter) ─► state at time_s ─► predict through what is pending ─► state at apply_s
                                                                                             │
         reference, flow, fan ahead ──────────────────────────────────────────────────► choose ─► output, horizon

Prediction takes the delays out: measuring, link, command lead and heater element are behind us when the choice
is made. The choice is one number u for the time from t on: with u held the controlled node is at
T* one prediction horizon H later. The model is almost linear in u, so two runs (u = 0 and u = full) give it:

    T(t+H | u) = T0 + u/full (T1 - T0)  =  T*         T* = r(t+H) - e(H)

    e(H) = e exp(-H/tau) for small deviations e = r - T;  e outside the proportional band counts as its edge

so a large deviation falls at full power, and its last degrees with the closed-loop time constant tau. Losses, fan,
melt of the planned flow and the learned disturbance are in T0: that is the feed-forward. Limits are exact: the
output is cut to 0..full, to the step's limit, to the slew rate, and the next choice starts from what will be, not
from what was requested. Nothing is integrated but the disturbance, in the filter: nothing winds up.

The horizon: the same choice again from the predicted state, `ahead` times, should the host be late. What one
unit of output does within H is known from the two runs above, so each further choice takes one run: with the
output before it, and by how much that misses T*.

All of it is thermal/control/predictive.c; here it is given its input, and its output is taken from it.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import chelper
from thermal.models.heater_model import ModelParameters
from thermal.records import Planned
from thermal.sensing.samples import Samples

from .control_api import ControlInput, ControlOutput, Law
from .predictive_filter import ModelState

__all__ = ["MODEL", "ModelParameters", "ModelState", "model_follow", "model_step"]

PENDING_ROOM = 32  # decided before and not in force yet; more are taken, too

_FIGURES = struct.Struct("=7d4i")  # head of struct model_inputs
_OUTPUT = struct.Struct("=7di4x")  # head of struct model_output
_PLANNED = struct.Struct("=2d")
_new_output = partial(tuple.__new__, ControlOutput)
_new_planned = partial(tuple.__new__, Planned)


class StepOutput:
    """Where C leaves what a step has found."""

    def __init__(self) -> None:
        self._ffi = chelper.get_ffi()[0]
        self._state_type = self._ffi.typeof("struct model_state *")
        self.raw = self._ffi.new("struct model_output *")
        self._bytes = self._ffi.buffer(self.raw)

    def new_state(self) -> Any:
        """For the memory after a step."""
        return self._ffi.new(self._state_type)

    def read(self) -> tuple[Sequence[float], tuple[Planned, ...]]:
        """The figures of ControlOutput, and its horizon."""
        *figures, count = _OUTPUT.unpack_from(self._bytes)
        if not count:
            return figures, ()
        rows = self._bytes[_OUTPUT.size : _OUTPUT.size + count * _PLANNED.size]
        return figures, tuple(map(_new_planned, _PLANNED.iter_unpack(rows)))


class _Buffers:
    """Where a step's input and output lie in C: one for all heaters, one step after another."""

    def __init__(self) -> None:
        self.ffi, self.lib = chelper.get_ffi()
        self.given = self.ffi.new("struct model_inputs *")
        self.found = StepOutput()
        self._figures = self.ffi.buffer(self.given)
        self._room = 0
        self._make_room(PENDING_ROOM)

    def _make_room(self, count: int) -> None:
        self._room = count
        self._pending = self.ffi.new("struct model_planned[]", count)
        self._pending_bytes = self.ffi.buffer(self._pending)
        self.given.pending = self._pending

    def put(self, inputs: ControlInput, time_s: float, samples: Samples) -> None:
        """Write the input; its samples, reference, flow and fan are pointed to."""
        given, pending = self.given, inputs.pending or ()
        count = len(pending)
        if count > self._room:
            self._make_room(2 * count)
        for i, planned in enumerate(pending):
            _PLANNED.pack_into(self._pending_bytes, i * _PLANNED.size, *planned)
        _FIGURES.pack_into(
            self._figures,
            0,
            time_s,
            inputs.reference_c,
            inputs.measured_c,
            inputs.limit,
            inputs.sigma_c,
            inputs.applied,
            inputs.apply_s,
            inputs.rebased,
            inputs.pending is None,
            samples.size,
            count,
        )
        given.samples = samples.raw
        given.flow, given.fan = inputs.flow_mm3_s.packed(), inputs.fan.packed()
        given.reference = inputs.reference.packed() if inputs.reference is not None else self.ffi.NULL


_buffers = cache(_Buffers)


def model_step(
    p: ModelParameters, state: ModelState, inputs: ControlInput, time_s: float
) -> tuple[ControlOutput, ModelState]:
    """One step with the measurements up to `time_s`; the output is meant from apply_s on."""
    buffers, samples = _buffers(), Samples.of(inputs.samples)
    buffers.put(inputs, time_s, samples)
    after = buffers.found.new_state()
    buffers.lib.model_step(p.packed(), state.raw, buffers.given, after, buffers.found.raw)
    figures, horizon = buffers.found.read()
    return _new_output((*figures, horizon)), ModelState(after)


def model_follow(p: ModelParameters, state: ModelState, inputs: ControlInput, output: float) -> ModelState:
    """Somebody else's output: noted, so that prediction and slew rate start from it.

    A filter that knows nothing yet begins at the newest of `inputs.samples`, with `output` as what holds it there.
    """
    ffi, lib = chelper.get_ffi()
    seen, raw = Samples.of(inputs.samples), state.copied()
    newest = seen.raw + (seen.size - 1) if seen.size else ffi.NULL
    lib.model_follow(p.packed(), raw, newest, inputs.flow_mm3_s.packed(), inputs.fan.packed(), output)
    return ModelState(raw)


MODEL: Law[ModelParameters, ModelState] = Law("model", model_step, ModelState(), model_follow)
