"""The commands sent to the bridge, and where its next command may begin. The work is done in C (bridge.h).

A list of commands sent replaces everything pending from its first time on (induction_plan), so what is known of
the future is always the newest plan. Commands begin on edges between two blocks, so that no block is cut:

    blocks  |settle|--block--|--block--|--block--|--block--|
                             ^ known edge        ^ edge >= now + lead: the command's time
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import chelper
from thermal.records import PhaseCommand

REFRESH_SHARE = 1.0 / 3.0
_COMMAND = struct.Struct("=dqd")  # struct phase_command
_new_command = partial(tuple.__new__, PhaseCommand)


@dataclass(frozen=True, slots=True)
class Timing:
    """When commands may start and how blocks lie in time."""

    block_s: float  # whole block
    settle_s: float  # discarded after a phase step
    lead_s: float  # a command is sent at least this much before it holds
    max_duration_s: float  # the bridge turns itself off when no command holds for so long
    stale_s: float = 0.15  # no temperature for this long: stop heating blindly
    control_s: float = 0.0  # commands are at least this much apart: a step costs settling samples
    refresh_s: float = field(init=False)  # longest time between commands while the bridge is on

    def __post_init__(self) -> None:
        object.__setattr__(self, "refresh_s", self.max_duration_s * REFRESH_SHARE)

    @property
    def stride_s(self) -> float:
        """From one command to the next, when every one is followed as soon as may be."""
        blocks = max(1, math.ceil((self.control_s - self.settle_s) / self.block_s - 1e-6))
        return self.settle_s + blocks * self.block_s


def commands_of(raw: Any, count: int) -> list[PhaseCommand]:
    """Python's records of C's struct phase_command."""
    if not count:
        return []
    data = chelper.get_ffi()[0].buffer(raw, count * _COMMAND.size)
    return list(map(_new_command, _COMMAND.iter_unpack(data)))


class Bridge:
    """What was sent to one bridge and what its actuator owes: C's struct bridge_state, `raw`."""

    __slots__ = ("_lib", "_line", "raw")

    def __init__(self) -> None:
        ffi, self._lib = chelper.get_ffi()
        self.raw: Any = ffi.new("struct bridge_state *")
        self._line = ffi.addressof(self.raw, "line")
        self._lib.timeline_reset(self._line)
        self.restart_actuator()

    def restart_actuator(self) -> None:
        """Nothing is owed, and nothing is known of the drive."""
        self._lib.actuator_reset(chelper.get_ffi()[0].addressof(self.raw, "actuator"))

    @property
    def driving(self) -> bool:
        """Continuous drive, no pulses."""
        return bool(self.raw.actuator.driving)

    @property
    def commands(self) -> list[PhaseCommand]:
        """In order of time: the newest that is surely in force, and all after it."""
        return commands_of(self._line.commands, self._line.count)

    @property
    def head(self) -> PhaseCommand:
        """First of the newest plan."""
        head = self._line.head
        return PhaseCommand(head.time_s, head.phase_ticks, head.power_w)

    def edge(self, edge_s: float) -> None:
        """An edge between two blocks."""
        self._line.edge_s = edge_s

    def note(self, commands: Sequence[PhaseCommand], now_s: float) -> None:
        """These are sent now."""
        raw = chelper.get_ffi()[0].new("struct phase_command[]", list(commands))
        self._lib.timeline_note(self._line, raw, len(commands), now_s)

    def last_before_s(self, time_s: float) -> float:
        """When the command in force just before `time_s` began."""
        return float(self._lib.timeline_last_before(self._line, time_s).time_s)

    def strongest_w(self, from_s: float, until_s: float) -> float:
        """The strongest command in force between the two; NaN: not known."""
        return float(self._lib.timeline_strongest_w(self._line, from_s, until_s))

    def is_on_from(self, time_s: float) -> bool:
        """Is the bridge on at `time_s` or later, if nothing more is sent?"""
        return bool(self._lib.timeline_is_on_from(self._line, time_s))
