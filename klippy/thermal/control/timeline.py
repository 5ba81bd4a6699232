"""The commands sent to the bridge, and where its next command may begin.

A list of commands sent replaces everything pending from its first time on (induction_plan), so what is known of
the future is always the newest plan. Commands begin on edges between two blocks, so that no block is cut:

    blocks  |settle|--block--|--block--|--block--|--block--|
                             ^ known edge        ^ edge >= now + lead: the command's time
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from thermal.records import PhaseCommand, Planned

TIME_SLACK_S = 1e-7  # rounding of print times against clocks, far below a bridge period

REFRESH_SHARE = 1.0 / 3.0
KEEP_S = 0.4  # a block comes this late at most before the loop counts as blind

NOT_COMMANDED = PhaseCommand(-math.inf, 0, 0.0)


@dataclass(frozen=True, slots=True)
class Timing:
    """When commands may start and how blocks lie in time."""

    block_s: float  # whole block
    settle_s: float  # discarded after a phase step
    lead_s: float  # a command is sent at least this much before it holds
    max_duration_s: float  # the bridge turns itself off when no command holds for so long
    stale_s: float = 0.15  # no temperature for this long: stop heating blindly
    control_s: float = 0.0  # commands are at least this much apart: a step costs settling samples

    @property
    def refresh_s(self) -> float:
        """Longest time between commands while the bridge is on."""
        return self.max_duration_s * REFRESH_SHARE

    @property
    def stride_s(self) -> float:
        """From one command to the next, when every one is followed as soon as may be."""
        blocks = max(1, math.ceil((self.control_s - self.settle_s) / self.block_s - 1e-6))
        return self.settle_s + blocks * self.block_s


@dataclass(slots=True)
class Timeline:
    """Commands of one bridge in order of time: the newest that is surely in force, and all after it."""

    edge_s: float = -math.inf  # an edge between two blocks
    commands: list[PhaseCommand] = field(default_factory=lambda: [NOT_COMMANDED])
    head: PhaseCommand = NOT_COMMANDED  # first of the newest plan

    @property
    def newest(self) -> PhaseCommand:
        return self.commands[-1]

    def note(self, commands: list[PhaseCommand], now_s: float) -> None:
        """These are sent now."""
        if not commands:
            return
        self.head = commands[0]
        start_s = commands[0].time_s - TIME_SLACK_S
        kept = [c for c in self.commands if c.time_s < start_s]
        past = sum(1 for c in kept if c.time_s <= now_s - KEEP_S)
        self.commands = kept[max(0, past - 1) :] + commands

    def last_before(self, time_s: float) -> PhaseCommand:
        """The command in force just before `time_s`."""
        for command in reversed(self.commands):
            if command.time_s < time_s:
                return command
        return self.commands[0]

    def is_on_from(self, time_s: float) -> bool:
        """Is the bridge on at `time_s` or later, if nothing more is said?"""
        if self.last_before(time_s + TIME_SLACK_S).phase_ticks:
            return True
        return any(c.phase_ticks for c in self.commands if c.time_s > time_s)

    def at(self, time_s: float) -> PhaseCommand | None:
        """The command that begins at `time_s`, if one does."""
        for command in reversed(self.commands):
            if command.time_s <= time_s + TIME_SLACK_S:
                return command if command.time_s >= time_s - TIME_SLACK_S else None
        return None

    def pending(self, after_s: float, until_s: float) -> tuple[Planned, ...]:
        """Heat (W) of the commands that begin within this time."""
        return tuple(Planned(c.time_s, c.power_w) for c in self.commands if after_s <= c.time_s < until_s)

    def differs(self, plan: Sequence[Planned], by_w: float) -> bool:
        """Whether, from the plan's first time on, what was sent differs from it by more than this anywhere."""
        first_s = plan[0].time_s + TIME_SLACK_S
        for planned in plan:
            if abs(self.last_before(planned.time_s + TIME_SLACK_S).power_w - planned.value) > by_w:
                return True
        i = 0
        for command in self.commands:
            if command.time_s > first_s:
                while i + 1 < len(plan) and plan[i + 1].time_s <= command.time_s + TIME_SLACK_S:
                    i += 1
                if abs(command.power_w - plan[i].value) > by_w:
                    return True
        return False

    def edge(self, timing: Timing, earliest_s: float) -> float:
        """First edge between two blocks not before `earliest_s`, given the commands already sent."""
        edge_s = self.edge_s
        before = self.last_before(earliest_s + TIME_SLACK_S)
        if before.time_s > edge_s:
            edge_s = before.time_s + timing.settle_s
        if edge_s == -math.inf:
            return earliest_s
        blocks = math.ceil((earliest_s - edge_s) / timing.block_s - 1e-6)
        return edge_s + max(0, blocks) * timing.block_s

    def slot(self, timing: Timing, now_s: float, apart_s: float, lead_s: float) -> float:
        """Where a command sent now may begin: lead time ahead and `apart_s` after the last that stays."""
        earliest_s = now_s + lead_s
        settled = self.last_before(earliest_s)
        return self.edge(timing, max(earliest_s, settled.time_s + apart_s))
