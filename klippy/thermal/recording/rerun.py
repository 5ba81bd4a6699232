"""A recorded run decided again: the same inputs into the loop of this version, its answers beside the recorded ones."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import chelper
from thermal.control.control_api import Schedule
from thermal.control.loop import InductionLoop
from thermal.records import PhaseCommand
from thermal.sensing.blocks import Blocks

from . import plain, recorder, stored

_NOW = struct.Struct("<d")


@dataclass(frozen=True, slots=True)
class Answer:
    """What the loop said to one input: print time, estimate (degC), request (W), commands (time, phase)."""

    now_s: float
    temp_c: float
    power_w: float
    commands: tuple[tuple[float, int], ...]


@dataclass(slots=True)
class Rerun:
    """Both sides of a run, answer by answer."""

    header: dict[str, Any] = field(default_factory=dict)
    recorded: list[Answer] = field(default_factory=list)
    again: list[Answer] = field(default_factory=list)
    fault: tuple[str, str] = ("", "")  # recorded, again
    fault_s: tuple[float, float] = (math.nan, math.nan)
    gaps: list[str] = field(default_factory=list)  # what could not be decided again

    def is_same(self) -> bool:
        """Bit for bit."""
        return repr(self.recorded) == repr(self.again) and self.fault == self.fault

    def figures(self) -> dict[str, float]:
        """How far apart the two sides are; temperatures in degC, power in W, NaN where there is nothing."""
        pairs = list(zip(self.recorded, self.again, strict=True))
        temps = [b.temp_c - a.temp_c for a, b in pairs if not math.isnan(b.temp_c - a.temp_c)]
        powers = [b.power_w - a.power_w for a, b in pairs]
        seen = [a.temp_c for _, a in pairs if not math.isnan(a.temp_c)]
        return {
            "answers": len(pairs),
            "changed": sum(repr(a) != repr(b) for a, b in pairs),
            "valid_changed": sum(math.isnan(a.temp_c) != math.isnan(b.temp_c) for a, b in pairs),
            "temp_max_c": max(map(abs, temps), default=0.0),
            "temp_rms_c": math.sqrt(sum(t * t for t in temps) / len(temps)) if temps else 0.0,
            "power_max_w": max(map(abs, powers), default=0.0),
            "highest_c": max(seen, default=math.nan),
            "last_c": seen[-1] if seen else math.nan,
            "commands": sum(len(a.commands) for _, a in pairs),
            "energy_j": self._energy_j(),
        }

    def _energy_j(self) -> float:
        rows = self.again
        return sum(a.power_w * (b.now_s - a.now_s) for a, b in pairwise(rows))


def _answer(now_s: float, loop: InductionLoop, commands: Iterable[PhaseCommand]) -> Answer:
    state = loop.state
    rows = tuple((command.time_s, command.phase_ticks) for command in commands)
    return Answer(now_s, state.estimate.temp_c, state.request.power_w, rows)


def _recorded(now_s: float, payload: bytes) -> Answer:
    _, temp_c, _, power_w = struct.unpack_from("<4d", payload)
    return Answer(now_s, temp_c, power_w, tuple(struct.iter_unpack("<dH", payload[32:])))


def _schedule(frame: stored.Frame) -> Schedule:
    before, *rest = frame.doubles()
    half = len(rest) // 2
    return Schedule(tuple(rest[:half]), tuple(rest[half:]), before)


def blocks_of(payload: bytes) -> Blocks:
    """The blocks of a frame."""
    ffi, blocks = chelper.get_ffi()[0], Blocks()
    size, into = ffi.sizeof("struct coil_block"), ffi.buffer(blocks.raw)
    blocks.count = len(payload) // recorder.RAW_BYTES
    for i in range(blocks.count):
        at = i * recorder.RAW_BYTES
        into[i * size : i * size + recorder.RAW_BYTES] = payload[at : at + recorder.RAW_BYTES]
    return blocks


def restore(loop: InductionLoop, memory: dict[str, Any]) -> None:
    """Put a recorded memory into a loop."""
    loop.state = plain.restored(memory["state"])
    loop.parameters = loop.parameters  # its driver works on that state
    plain.fill_struct(loop.chain.state, memory["chain"])
    for sample, values in zip(loop.chain.hold(len(memory["waiting"])), memory["waiting"], strict=True):
        plain.fill_struct(sample, values)
    loop.quiet = memory["quiet"]
    loop.flow, loop.fan = plain.restored(memory["flow"]), plain.restored(memory["fan"])
    loop.reference = plain.restored(memory["reference"])


class _Player:
    """One pass through the frames."""

    def __init__(self, on_blocks: Callable[[Blocks], None]) -> None:
        self.run = Rerun()
        self.loop: InductionLoop | None = None
        self._pending: Answer | None = None
        self._is_fresh = True  # the next state frame holds: nothing has been decided since
        self._on_blocks = on_blocks

    def play(self, frame: stored.Frame) -> None:
        kind = frame.kind
        if kind == "H":
            self.run.header = frame.json()
            self.loop = InductionLoop(plain.restored(self.run.header["parameters"]))
        elif self.loop is None:
            raise stored.RunFileError("a recorded run begins with its header")
        elif kind == "E":
            self.run.gaps.append(frame.payload.decode())
            self._is_fresh = True
        elif kind == "S":
            if self._is_fresh:
                restore(self.loop, frame.json())
        elif kind == "o":
            self._compare(frame.payload)
        elif kind == "X":
            self._note_fault(frame.payload.decode())
        else:
            self._input(self.loop, frame)

    def _input(self, loop: InductionLoop, frame: stored.Frame) -> None:
        kind = frame.kind
        if kind in "FA":
            setattr(loop, "flow" if kind == "F" else "fan", _schedule(frame))
        elif kind == "Q":
            loop.quiet = bool(frame.payload[0])
        elif kind == "P":
            loop.parameters = plain.restored(frame.json())
        elif kind == "U":
            loop.use(plain.restored(frame.json()))
        elif kind == "f":
            loop.restart_filter()
        elif kind in "sr":
            (loop.start if kind == "s" else loop.resume)(_NOW.unpack(frame.payload)[0])
            self._is_fresh = kind == "r"
        elif not (self.run.gaps and self._is_fresh):
            self._decide(loop, frame)

    def _decide(self, loop: InductionLoop, frame: stored.Frame) -> None:
        (now_s,) = _NOW.unpack_from(frame.payload)
        self._is_fresh = False
        if frame.kind == "b":
            blocks = blocks_of(frame.payload[8:])
            self._on_blocks(blocks)
            commands = loop.on_blocks(blocks, now_s)
        elif frame.kind == "t":
            commands = loop.on_timer(now_s)
        elif frame.kind == "g":
            commands = loop.set_target(frame.doubles()[1], now_s)
        elif frame.kind == "R":
            _, *rest = frame.doubles()
            half = len(rest) // 2
            commands = loop.set_reference(list(zip(rest[:half], rest[half:], strict=True)), now_s)
        else:
            raise stored.RunFileError(f"a frame of the unknown kind '{frame.kind}'")
        self._pending = _answer(now_s, loop, commands)
        if loop.fault and not self.run.fault[1]:
            self.run.fault = (self.run.fault[0], loop.fault)
            self.run.fault_s = (self.run.fault_s[0], now_s)

    def _compare(self, payload: bytes) -> None:
        if self._pending is not None:
            self.run.recorded.append(_recorded(self._pending.now_s, payload))
            self.run.again.append(self._pending)
            self._pending = None

    def _note_fault(self, text: str) -> None:
        if not self.run.fault[0] and self.run.again:
            self.run.fault = (text, self.run.fault[1])
            self.run.fault_s = (self.run.again[-1].now_s, self.run.fault_s[1])


def rerun(frames: Iterable[stored.Frame], on_blocks: Callable[[Blocks], None] = lambda blocks: None) -> Rerun:
    """Decide a run again. `on_blocks` sees the blocks before the loop does. Raises RunFileError, UnknownType."""
    player = _Player(on_blocks)
    for frame in frames:
        player.play(frame)
    return player.run
