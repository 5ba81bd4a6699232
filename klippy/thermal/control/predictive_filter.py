"""Kalman filter of predictive control (`control: model`): temperatures, disturbance power and gain of the drive.

State of the covariance, in this order, missing nodes left out: element, controlled node, second mass, sensor,
disturbance d (W), drive gain g, slant k (degC at full drive). Bore and flow follow the controlled node without
uncertainty of their own.

    mean        the model runs through the outputs that were in force, sample by sample
    covariance  P <- F P F' + Q once a call, F = 1 + A dt + ..., A the slopes of the model at the present state
    update      the samples of one call (a message of blocks) enter as one: their mean innovation, weighted

d walks at random, g nearly stands: heat that follows the power (another mass, another coupling) is learned as g
during a climb, heat that does not (melt, draught, other losses) as d.

A sensing law that has drifted is off by another amount at each drive: more drive, a colder reading, at once, while the
heat comes later. To a loop that is a zero in the right half plane, and a fast one hunts. So

    reading = T + k (u - u0)        u the drive as a share of full, u0 the usual drive of the last 0.2 s

where k is learned as the reading moves with the drive; T is what would be read at u0, and moves by k du0 with it.
Which of the readings is right is not known; only that the temperature does not step with the drive.

A step of the drive cannot step the temperature. Where the reading steps with it (a sensing law that has drifted
is off by another amount at each power), that offset is taken out as long as the drive stays up: else full power,
read as too cold, would call for more full power. Steps without one move the temperature and teach nothing.

The filter is thermal/control/predictive_filter.c, what tunes it for all heaters alike
thermal/control/predictive_filter.h.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import chelper
from thermal.models.heater_model import ModelParameters, Nodes, nodes_of
from thermal.records import Planned, Sample
from thermal.sensing.samples import Samples

from .control_api import IDLE, Schedule


class ModelState:
    """Memory of the predictive law: the fields of C's struct model_state (thermal/control/predictive_filter.h).

    Never changed once it is made: a step makes another.
    """

    __slots__ = ("_raw",)

    def __init__(self, raw: Any = None) -> None:
        self._raw = raw  # None: nothing known yet, and nobody has asked

    @property
    def raw(self) -> Any:
        if self._raw is None:
            ffi, lib = chelper.get_ffi()
            self._raw = ffi.new("struct model_state *")
            lib.model_reset(self._raw)
        return self._raw

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)

    @property
    def known(self) -> bool:
        return bool(self.raw.time_s == self.raw.time_s)

    @property
    def nodes(self) -> Nodes:
        return nodes_of(self.raw.nodes)

    @property
    def covariance(self) -> tuple[tuple[float, ...], ...]:
        size = self.raw.size
        return tuple(tuple(row[0:size]) for row in self.raw.covariance[0:size])

    @property
    def sent(self) -> tuple[Planned, ...]:
        """Own outputs, where the caller does not know what is pending."""
        return tuple(Planned(sent.time_s, sent.value) for sent in self.raw.sent[0 : self.raw.sent_count])

    def copied(self) -> Any:
        """Another struct model_state, to be worked on."""
        ffi = chelper.get_ffi()[0]
        raw = ffi.new("struct model_state *")
        raw[0] = self.raw[0]
        return raw

    def replaced(self, **fields: Any) -> ModelState:
        """The same but for these fields of the struct."""
        raw = self.copied()
        for name, value in fields.items():
            setattr(raw, name, value)
        return ModelState(raw)


def begin(p: ModelParameters, temp_c: float, time_s: float, before: ModelState | None = None) -> ModelState:
    """A state that knows one temperature; the drive's gain is kept from `before`, if any."""
    raw = (before or ModelState()).copied()
    chelper.get_ffi()[1].model_begin(p.packed(), raw, temp_c, time_s)
    return ModelState(raw)


def taken_over(p: ModelParameters, state: ModelState, disturbance_w: float) -> ModelState:
    """A state just begun, with a known disturbance: it holds most of what was uncertain about gain and second mass."""
    raw = state.copied()
    chelper.get_ffi()[1].model_taken_over(p.packed(), raw, disturbance_w)
    return ModelState(raw)


def observe(
    p: ModelParameters,
    state: ModelState,
    samples: Sequence[Sample],
    flow: Schedule = IDLE,
    fan: Schedule = IDLE,
) -> ModelState:
    """The state after these samples, in order of time."""
    seen, raw = Samples.of(samples), state.copied()
    chelper.get_ffi()[1].model_observe(p.packed(), raw, seen.raw, seen.size, flow.packed(), fan.packed())
    return ModelState(raw)
