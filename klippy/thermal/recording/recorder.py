"""A nozzle's loop that writes down every input and what it answered.

A recorded loop is the loop: the same object state, the same verbs, each followed by a frame (stored.py). The frames go
to a `Sink`: a file, or a ring that keeps the last seconds for the case of a fault.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import chelper
from thermal.control.control_api import Reference, Schedule
from thermal.control.loop import InductionLoop, LoopParameters
from thermal.records import PhaseCommand
from thermal.sensing.blocks import Blocks

from . import plain, stored

RAW_BYTES = 64  # of struct coil_block: the fields as the MCU sent them
SEGMENT_S = 10.0  # the ring forgets in pieces of this length; each begins with the whole state

Sink = Callable[[bytes], None]
_NOW = struct.Struct("<d")
_TARGET = struct.Struct("<2d")
_OUTPUT = struct.Struct("<4d")
_COMMAND = struct.Struct("<dH")


def header(parameters: LoopParameters, about: dict[str, Any]) -> bytes:
    """The first frame. `about`: version, heater, unit, guard rows."""
    return stored.json_frame("H", {"format": 1, **about, "parameters": plain.plain(parameters)})


def state_frame(loop: InductionLoop) -> bytes:
    """All that the loop remembers."""
    memory = {
        "state": plain.plain(loop.state),
        "chain": plain.of_struct(loop.chain.state),
        "waiting": [plain.of_struct(sample) for sample in loop.chain.held()],
        "quiet": loop.quiet,
        "flow": plain.plain(loop.flow),
        "fan": plain.plain(loop.fan),
        "reference": plain.plain(loop.reference),
    }
    return stored.json_frame("S", memory)


def _points(first: float, times: Sequence[float], values: Sequence[float]) -> bytes:
    return struct.pack(f"<{1 + 2 * len(times)}d", first, *times, *values)


def block_bytes(blocks: Blocks) -> bytes:
    """The blocks as they were sent."""
    buffer, size = chelper.get_ffi()[0].buffer, chelper.get_ffi()[0].sizeof("struct coil_block")
    data = buffer(blocks.raw, blocks.count * size)
    return b"".join(data[at : at + RAW_BYTES] for at in range(0, blocks.count * size, size))


class RecordedLoop(InductionLoop):
    """The loop that `recorded` gives."""

    sink: Sink
    has_gap = False  # what happens now cannot be decided again

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value)
        if name in ("flow", "fan"):
            line: Schedule = value
            kind = "F" if name == "flow" else "A"
            self.sink(stored.packed(kind, _points(line.before, line.times_s, line.values)))
        elif name == "quiet":
            self.sink(stored.packed("Q", bytes([bool(value)])))
        elif name == "parameters" and not self.has_gap:
            self.sink(stored.json_frame("P", plain.plain(value)))

    def _answer(self, kind: str, payload: bytes, commands: list[PhaseCommand]) -> list[PhaseCommand]:
        state = self.state
        news = state.estimate
        out = _OUTPUT.pack(news.time_s, news.temp_c, news.sigma_c, state.request.power_w)
        rows = b"".join(_COMMAND.pack(command.time_s, command.phase_ticks) for command in commands)
        self.sink(stored.packed(kind, payload) + stored.packed("o", out + rows))
        if self.fault:
            self.sink(stored.packed("X", self.fault.encode()))
        return commands

    def use(self, parameters: LoopParameters) -> None:
        try:
            self.sink(stored.json_frame("U", plain.plain(parameters)))
        except plain.UnknownType as e:  # a calibration run is the control law
            self.sink(stored.packed("E", str(e).encode()))
            self.has_gap = True
            super().use(parameters)
            return
        super().use(parameters)
        if self.has_gap:
            self.has_gap = False
            self.sink(state_frame(self))

    def start(self, now_s: float) -> None:
        super().start(now_s)
        self.sink(stored.packed("s", _NOW.pack(now_s)))

    def restart_filter(self) -> None:
        super().restart_filter()
        self.sink(stored.packed("f", b""))

    def resume(self, now_s: float) -> None:
        super().resume(now_s)
        self.sink(stored.packed("r", _NOW.pack(now_s)) + state_frame(self))

    def set_target(self, target_c: float, now_s: float) -> list[PhaseCommand]:
        return self._answer("g", _TARGET.pack(now_s, target_c), super().set_target(target_c, now_s))

    def set_reference(
        self, points: Sequence[tuple[float, float]] | Reference, now_s: float
    ) -> list[PhaseCommand]:
        commands = super().set_reference(points, now_s)
        line = Reference.of(points) if points else None
        given = _points(now_s, line.times_s, line.temps_c) if line is not None else _NOW.pack(now_s)
        return self._answer("R", given, commands)

    def on_blocks(self, blocks: Blocks, now_s: float) -> list[PhaseCommand]:
        given = _NOW.pack(now_s) + block_bytes(blocks)
        return self._answer("b", given, super().on_blocks(blocks, now_s))

    def on_timer(self, now_s: float) -> list[PhaseCommand]:
        return self._answer("t", _NOW.pack(now_s), super().on_timer(now_s))


def recorded(loop: InductionLoop, sink: Sink) -> RecordedLoop:
    """`loop` from now on recorded: use what is returned in its place. It shares the memory of the one given."""
    made = RecordedLoop.__new__(RecordedLoop)
    made.__dict__.update(loop.__dict__, sink=sink)
    return made


def unrecorded(loop: RecordedLoop) -> InductionLoop:
    """The loop without its recorder, to be used in its place."""
    made = InductionLoop.__new__(InductionLoop)
    made.__dict__.update({name: value for name, value in loop.__dict__.items() if name != "sink"})
    return made


class Ring:
    """The newest `keep_s` seconds of frames and up to SEGMENT_S more."""

    def __init__(self, keep_s: float, begin: Callable[[], bytes]) -> None:
        self._segments: deque[list[bytes]] = deque()
        self._starts: deque[float] = deque()
        self._keep_s, self._begin = keep_s, begin

    def tick(self, now_s: float) -> None:
        """Between two verbs: begin another segment if it is time."""
        if self._starts and now_s - self._starts[-1] < SEGMENT_S:
            return
        self._starts.append(now_s)
        self._segments.append([self._begin()])
        while len(self._starts) > 1 and now_s - self._starts[1] >= self._keep_s:
            self._starts.popleft()
            self._segments.popleft()

    def take(self, frames: bytes) -> None:
        if self._segments:
            self._segments[-1].append(frames)

    def frames(self) -> bytes:
        return b"".join(frame for segment in self._segments for frame in segment)
