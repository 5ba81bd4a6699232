"""What all controllers share: one verb and the records it takes and gives.

    output, state = law.step(parameters, state, inputs, time_s)

Parameters, state, input and output are frozen: nothing is changed in place, so a controller can be replayed
from a log, compared with another on the same data, and swapped with `follow` without a bump. `time_s` is the
time of the measurement, not of the call. Output units are what the parameters say: watts where the drive law
is known (induction), duty 0..1 elsewhere.

    time ───── time_s ─────────────── apply_s ───────────────► print time, seconds
               measurement            output in force
               `applied`: mean output in force since the step before (NaN: what was returned before)

A law uses what it understands and leaves the rest: a PID looks at `reference_c` and `measured_c` only, the
predictive law also at sigma, times, reference ahead, flow and fan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import le
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import chelper
from thermal.records import Planned, Sample, require


def _line(times_s: tuple[float, ...], values: tuple[float, ...], before: float) -> Any:
    """C's struct model_line."""
    return chelper.get_ffi()[0].new("struct model_line *", (len(times_s), before, (*times_s, *values)))


class Reference:
    """A temperature over time: straight lines between corners, held before the first and after the last.

    `times_s` ascends (equal times make a step: the later corner counts from that instant on). Never changed once made.
    """

    __slots__ = ("_line",)

    def __init__(self, times_s: tuple[float, ...], temps_c: tuple[float, ...]) -> None:
        require(len(times_s) == len(temps_c) > 0, "a reference needs as many times as temperatures")
        finite = math.isfinite(sum(times_s)) and math.isfinite(sum(temps_c))
        require(finite, "a reference needs finite corners")
        ascending = all(map(le, times_s, times_s[1:]))
        require(ascending, "the corners of a reference must be in order of time")
        self._line = _line(times_s, temps_c, 0.0)

    @classmethod
    def of_pairs(cls, pairs: Any, count: int) -> Reference:
        """From C: `count` pairs of doubles (time_s, temp_c), finite and in order of time, at least one. Copied."""
        ffi, lib = chelper.get_ffi()
        made = cls.__new__(cls)
        made._line = ffi.new("struct model_line *", {"count": count, "at": 2 * count})
        lib.model_line_fill(made._line, ffi.cast("double *", pairs))
        return made

    @classmethod
    def of_line(cls, line: Any) -> Reference:
        """From C's own struct model_line, filled as of_pairs would, and kept."""
        made = cls.__new__(cls)
        made._line = line
        return made

    @property
    def times_s(self) -> tuple[float, ...]:
        return tuple(self._line.at[0 : self._line.count])

    @property
    def temps_c(self) -> tuple[float, ...]:
        return tuple(self._line.at[self._line.count : 2 * self._line.count])

    @property
    def end_s(self) -> float:
        """Time of the last corner."""
        return float(self._line.at[self._line.count - 1])

    def packed(self) -> Any:
        """As C's struct model_line."""
        return self._line

    def at(self, time_s: float) -> float:
        """Temperature in degC at this time."""
        return float(chelper.get_ffi()[1].model_line_corner(self._line, time_s))

    @staticmethod
    def of(points: Sequence[tuple[float, float]] | Reference) -> Reference:
        """From (time_s, temp_c) pairs, for example thermal.plan's corners; a reference stays as it is."""
        if isinstance(points, Reference):
            return points
        times_s, temps_c = zip(*points, strict=True) if len(points) else ((), ())
        return Reference(times_s, temps_c)


@dataclass(frozen=True, slots=True)
class Schedule:
    """A quantity that holds from each time to the next: planned flow in mm^3/s, fan 0..1. `before` the first."""

    times_s: tuple[float, ...] = ()
    values: tuple[float, ...] = ()
    before: float = 0.0
    _line: Any = field(init=False, default=None, repr=False, compare=False)  # see packed()

    def packed(self) -> Any:
        """As C's struct model_line; made once."""
        if self._line is None:
            object.__setattr__(self, "_line", _line(self.times_s, self.values, self.before))
        return self._line

    def at(self, time_s: float) -> float:
        return float(chelper.get_ffi()[1].model_line_step(self.packed(), time_s))

    @staticmethod
    def constant(value: float) -> Schedule:
        return Schedule((), (), value)


IDLE = Schedule()


class ControlInput(NamedTuple):
    """What every controller sees."""

    reference_c: float  # wanted at apply_s; 0 or less: heater off
    measured_c: float  # NaN: nothing measured this time
    feedforward: float = 0.0  # in output units, on top of what the law knows itself
    limit: float = math.inf  # output limit of this step, on top of the parameters' own
    rebased: bool = False  # the measurement jumped for reasons of its own: not a slope
    sigma_c: float = math.nan  # 1 sigma of the random part of measured_c; NaN: the parameters' own
    applied: float = math.nan  # mean output in force since the step before; NaN: as this law returned it
    apply_s: float = (
        math.nan
    )  # from when this output will be in force; NaN: time_s + the parameters' own delay
    reference: Reference | None = None  # the wanted temperature ahead; None: reference_c from now on
    samples: Sequence[Sample] = ()  # what measured_c is the newest of, where there are several to a step
    pending: tuple[Planned, ...] | None = (
        None  # decided before, in force until apply_s; None: as this law returned it
    )
    flow_mm3_s: Schedule = IDLE  # planned extrusion, past and ahead
    fan: Schedule = IDLE  # part fan 0..1, past and ahead


class ControlOutput(NamedTuple):
    """The limited output and its terms, all in output units."""

    value: float
    unlimited: float
    proportional: float
    integral: float
    derivative: float
    feedforward: float
    predicted_c: float = math.nan  # what a law with a model expects at apply_s
    horizon: tuple[Planned, ...] = ()  # what it means to do after `value`, should nothing new be said


P_contra = TypeVar("P_contra", contravariant=True)
S = TypeVar("S")


class Step(Protocol[P_contra, S]):
    """The role all control laws play."""

    def __call__(
        self, parameters: P_contra, state: S, inputs: ControlInput, time_s: float, /
    ) -> tuple[ControlOutput, S]: ...


class Follow(Protocol[P_contra, S]):
    """Bumpless transfer: a state from which the next step continues at `output`, set by somebody else."""

    def __call__(self, parameters: P_contra, state: S, inputs: ControlInput, output: float, /) -> S: ...


@dataclass(frozen=True, slots=True)
class Law(Generic[P_contra, S]):
    """A control law as a value: its verb, a fresh state, and how to take over."""

    name: str
    step: Step[P_contra, S]
    start: S
    follow: Follow[P_contra, S]
