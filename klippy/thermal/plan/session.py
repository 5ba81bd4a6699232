"""The temperature plan of one nozzle over a print: events in, corners out. Time is an argument.

    names of places, requests ─► note, hold ─┐
    moves with their times ─► moves ─────────┴► PathPieces ─► TemperaturePlan ─► work: a reference for the heater
    the user's target, bed, material ─► follow, move_target, set_bed, change ──────────┘

[temperature_plan] feeds a session while the printer prints, scripts/plan_temperature.py with a whole file. The plan
lies on top of the user's own target. It is planned again whenever enough new motion has come (path_pieces.c). The
part nearer than `COMMIT_S` is not changed.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Any

from thermal.control.control_api import Reference
from thermal.models.melt_exchange import NozzleLimits, idle_way

from .deposit import Surroundings
from .layer_time import LayerSpeed, LayerSpeeds, Place
from .materials import Material
from .path_pieces import Asked, PathPieces
from .planner import Deposited, PlanOptions, TemperaturePlan
from .requests import Requests, RequestTable

COMMIT_S = 0.20  # the plan nearer than this stays: commands for it may be on their way
RECORD_BEHIND_S = 0.5  # pieces are recorded when they are surely deposited
RETURN_S = 0.5  # from the last piece until the nozzle goes back to the user's target
ROWS_AT_ONCE = 4096
WITHIN_C = 0.02  # a straight line for corners that are so near it: far below what the thermometer sees
SAME_TIME_S = 1e-6  # a mark and the move behind it


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanSettings:
    """What a session works with."""

    material: Material
    surroundings: Surroundings
    options: PlanOptions
    table: RequestTable
    slowest: float  # minimum speed factor
    longest_pause_s: float  # before a layer


@dataclass(slots=True)
class Requested:
    """Temperatures requested by name."""

    table: RequestTable
    state: Requests = field(default_factory=Requests)  # at the end of the file as far as it has been read
    marks: deque[Requests] = field(
        default_factory=deque
    )  # each holds from a print time on; the first holds now
    asked: tuple[float | None, ...] = ()  # of the newest mark

    def __post_init__(self) -> None:
        self.marks.append(self.state)
        self.asked = self.state.asks(self.table)

    def at(self, time_s: float) -> Requests:
        """What holds at a print time; marks of the past go."""
        marks = self.marks
        while len(marks) > 1 and marks[1].since_s <= time_s + SAME_TIME_S:
            marks.popleft()
        return marks[0]


@dataclass(slots=True)
class UserTarget:
    """The nozzle temperature that the user has set."""

    base_c: float = 0.0
    moved_c: float = 0.0  # change of the target within the print


@dataclass(slots=True)
class Lead:
    """What the heater was given."""

    reference: Reference | None = None  # None: it holds the user's target
    end_s: float = -math.inf  # of what is planned
    going_home: bool = False  # nothing more came: the reference leads back to the user's target
    is_due: bool = False  # enough new motion has come for another plan


@dataclass(frozen=True, slots=True)
class Turn:
    """Result of one turn of the plan."""

    next_s: float = math.inf  # time of the next turn at the latest
    reference: Reference | None = None  # the heater follows this from now on; None: nothing new
    released: bool = False  # and then stays at its end, without a reference
    replanned: bool = False


class Session:
    """One heater's plan. Raises ValueError if its power cannot hold the lowest temperature."""

    def __init__(
        self,
        settings: PlanSettings,
        nozzle: NozzleLimits,
        bed_allowance: bool = True,
        keeps_rows: bool = False,
    ) -> None:
        self.settings = settings
        self.material = settings.material
        self.options = settings.options
        self.bed_allowance = bed_allowance  # near the bed a layer may be hotter before it is slowed down
        self.keeps_rows = keeps_rows  # until take_rows
        self.requested = Requested(settings.table)
        self.target = UserTarget()
        self.lead = Lead()
        self.fan = 0.0
        self._rows: list[Deposited] = []
        self.begin(nozzle, 0.0)

    def begin(self, nozzle: NozzleLimits, now_s: float) -> None:
        """An empty bed."""
        settings = self.settings
        plan = TemperaturePlan(nozzle, self.material, settings.surroundings, self.options)
        self.nozzle, self.around, self.plan = nozzle, settings.surroundings, plan
        self.path = PathPieces(math.pi / 4.0 * self.options.filament_mm**2)
        self.speeds = LayerSpeeds(settings.slowest, settings.longest_pause_s)
        self._speed_set_s, self.target.moved_c = -math.inf, 0.0
        if self.lead.reference is not None:  # the print before still lies ahead, or is on its way back
            plan.lead([(s, self.lead.reference.at(s)) for s in (now_s, now_s + COMMIT_S)])

    # Names of places

    def forget_requests(self) -> None:
        """Another file: nothing has been asked for."""
        self.requested = Requested(self.settings.table)

    def note(self, state: Requests) -> bool:
        """`state` holds for all lines read from now on. True: it differs from the one before; then `hold` it from the
        print time at which the queued moves end."""
        requested = self.requested
        requested.state = state
        asks = state.asks(requested.table)
        changed = asks != requested.asked
        requested.asked = asks
        return changed

    def hold(self, state: Requests, since_s: float) -> None:
        """`state` holds from this print time on."""
        self.requested.marks.append(replace(state, since_s=since_s))
        self.path.forget(since_s - SAME_TIME_S)

    def _ask(self, time_s: float, layer: int, z_mm: float) -> Asked:
        """Temperatures requested by name on the path from `time_s` on."""
        state, table, marks = self.requested.at(time_s), self.requested.table, self.requested.marks
        requested_c = state.request_c(table, time_s, layer, z_mm)
        until_s = marks[1].since_s - SAME_TIME_S if len(marks) > 1 else math.inf
        over_s = state.since_s + state.duration_s
        if time_s < over_s:
            until_s = min(until_s, over_s)
        by_place = bool(table.layers or table.heights_mm)
        return Asked(requested_c, self.target.base_c, state.height_mm, state.speed_factor, until_s, by_place)

    # Moves

    def moves(self, row: Any, count: int, print_time: float, fan: float) -> bool:
        """The first `count` moves of the look-ahead's row; the first begins at `print_time`. True: plan again."""
        self.fan = fan
        if self.path.note_planned(row, count, print_time, fan, self.lead.end_s):
            self.lead.is_due = True
            return True
        return False

    def take(self) -> None:
        """Waiting moves become part of the plan; nothing is planned again."""
        self.path.feed(self._ask, self.plan.take)

    # What is planned with

    def set_bed(self, bed_c: float) -> None:
        """The bed's target, above 0."""
        if bed_c != self.around.bed_c:
            self.around = replace(self.around, bed_c=bed_c)
            self._use()

    def change(self, material: Material, options: PlanOptions) -> None:
        """Material and plan options from now on."""
        self.material, self.options = material, options
        self._use()

    def _use(self) -> None:
        """Hand all of it to the plan; an interface that the config names moves with the user's target."""
        options = self.options
        if options.interface_c is not None and not options.follow_mm:
            options = replace(options, interface_c=options.interface_c + 0.5 * self.target.moved_c)
        self.plan.change(self.material, self.around, options)

    # The user's target

    def set_base(self, base_c: float) -> None:
        """The user's target for all that is not yet part of the plan."""
        self.target.base_c = base_c
        self.path.forget()

    def follow(self, reference: Reference | None, target_c: float, now_s: float) -> None:
        """What the heater follows and its target. Another reference than the plan's: the user has set a target."""
        own = reference is not None and reference is self.lead.reference
        if own and target_c:
            return
        base_c = 0.0 if own else target_c
        if self.lead.reference is not None and base_c <= 0.0:
            self.lead.end_s = now_s
            self.cut(now_s)
        self.lead.reference = None
        self.set_base(base_c)

    def move_target(self, target_c: float, now_s: float) -> Turn | None:
        """The user's M104. While a path is under way the plan shifts by it and goes on; None: no path."""
        lead = self.lead
        if lead.reference is None or lead.going_home or now_s + COMMIT_S >= lead.end_s:
            return None
        moved_c = target_c - self.target.base_c
        if not moved_c:
            return Turn()  # slicers repeat themselves
        self.set_base(target_c)
        self.target.moved_c += moved_c
        self._use()
        from_s = now_s + COMMIT_S
        self.plan.shift(from_s, moved_c)
        return self._given(self.plan.ahead(from_s, lead.reference.at(from_s), WITHIN_C))

    # The plan

    def work(self, now_s: float) -> Turn:
        """Plan again, lead the nozzle back to the user's target, or neither."""
        lead, turn = self.lead, Turn()
        if lead.is_due or self.path.facts().waiting:
            turn = Turn(lead.end_s - 2.0 * COMMIT_S)
            if self.target.base_c <= 0.0:
                self.path.drop(now_s)  # deposited without a target; moves still ahead may get one
            elif lead.is_due or now_s > turn.next_s:
                return self.replan(now_s)
        elif lead.reference is not None:
            turn = Turn(lead.end_s + RETURN_S)
            if now_s > turn.next_s:
                turn = replace(self.go_back(now_s), next_s=turn.next_s)
        self.record(now_s - RECORD_BEHIND_S)
        return turn

    def replan(self, now_s: float) -> Turn:
        """Plan again with all waiting moves."""
        lead, from_s, recorded_s = self.lead, now_s + COMMIT_S, now_s - RECORD_BEHIND_S
        if lead.reference is None:
            self.plan.lead([(now_s, self.target.base_c)])
        if self.keeps_rows:
            self.record(recorded_s)
        while (done := self.plan.turn(self.path, from_s, WITHIN_C, recorded_s)) is None:
            self.path.inquire(self._ask)
        lead.end_s, reference = done
        lead.is_due = lead.going_home = False
        return replace(self._given(reference), replanned=True)

    def _given(self, reference: Reference | None) -> Turn:
        if reference is not None:
            self.lead.reference = reference
        return Turn(reference=reference)

    def go_back(self, now_s: float) -> Turn:
        """No more moves: lead the nozzle back to the user's target."""
        lead = self.lead
        assert lead.reference is not None
        from_c = lead.reference.at(now_s)
        lead.going_home = True
        holder_c = self.plan.holder_c(now_s, from_c)
        way = idle_way(self.nozzle, now_s, from_c, holder_c, self.target.base_c)
        self.plan.lead(way)
        turn = replace(self._given(Reference.of(way)), released=len(way) == 1)
        lead.end_s = way[-1][0] - RETURN_S
        if turn.released:
            lead.reference = None
        return turn

    def cut(self, now_s: float) -> None:
        """Drop the plan and the moves that lie ahead."""
        self.plan.cut(now_s)
        self.path.drop()

    # The speed of hot layers: what is left where even the coolest melt is too hot

    @property
    def speed_factor(self) -> float:
        """Part of the file's own speed."""
        return self.speeds.now.factor

    def full_speed(self) -> None:
        self.speeds.now = LayerSpeed()

    def choose_speed(self) -> LayerSpeed:
        """Speed factor of the layer that begins, and the pause before it."""
        facts = self.path.facts()
        place = Place(facts.z_mm, facts.height_mm, self.fan)
        interface_c = self.plan.speed_interface_c if self.bed_allowance else self.plan.interface_c
        self._speed_set_s = self.lead.end_s
        return self.speeds.layer(self.plan.ages(), interface_c, self.material, self.around, place)

    def is_round(self) -> bool:
        """In a file that announces no layers: has about one been deposited since the speed was chosen?"""
        if self.requested.state.layer or not self.speeds.is_used:
            return False
        return self.speeds.is_round(self.plan.ages(), self.lead.end_s - self._speed_set_s)

    # What has been deposited

    def record(self, until_s: float) -> None:
        """Record what has been deposited by this time."""
        self._rows += self.plan.finish(until_s, ROWS_AT_ONCE if self.keeps_rows else 0)

    def take_rows(self) -> list[Deposited]:
        """The rows recorded since the last call."""
        rows, self._rows = self._rows, []
        return rows
