"""The temperature plan of a whole file, offline: the same planning as in the printer, on a timed path.

GcodePath ─► PathPieces ─► TemperaturePlan ─► rows: what each move was planned to be, and its place on the part
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from extras.temperature_plan.settings import HEADROOM_C, Settings
from thermal.models.melt_exchange import NozzleLimits
from thermal.plan import weld
from thermal.plan.deposit import Surroundings
from thermal.plan.layer_time import Pace, Pacer, Place
from thermal.plan.path_pieces import Asked, PathPieces
from thermal.plan.planner import Laid, Summary, TemperaturePlan

from .gcode_path import GcodePath, Limits, TimedMove

AHEAD_S = 2.0  # motion that the printer knows ahead (toolhead.BUFFER_FULL_S)
WINDOW_S = 2.0  # so much new motion, then another plan
BOOK_ROWS = 65536


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """One extruding move: where, when, and its temperatures (degC, mean over the move)."""

    line: int
    layer: int
    start_mm: tuple[float, float, float]
    end_mm: tuple[float, float, float]
    start_s: float
    wall_c: float
    melt_c: float
    substrate_c: float
    interface_c: float
    interface_fixed_c: float
    pace: float  # part of the file's own speed


class PaceChange(NamedTuple):
    """Before this line of the file the print gets another speed, or waits."""

    line: int
    pace: Pace


@dataclass(frozen=True, slots=True)
class OfflinePlan:
    """The result for a file."""

    moves: list[PlannedMove]
    corners: np.ndarray  # (n, 2): print time s, nozzle degC
    summary: Summary
    duration_s: float
    base_c: float
    paces: list[PaceChange]
    other_tool_line: int = -1  # where the file takes a tool with another nozzle first, from 0; -1: nowhere


def steady(settings: Settings, plain: Summary, paced: Summary) -> Settings:
    """The whole file is known: the weld is held at one temperature from the first road on.

    `plain`: of the file at its own speed, whose fixed temperature tells the usual weld; `paced`: with hot layers slowed
    down, which tells what the window can still make of the ends of the path.
    """
    least_c = settings.options.interface_c or 0.0
    kept_c = weld.held_c(plain.interface_5_50_95_c[1][1], paced.band_c, least_c)
    return replace(settings, options=replace(settings.options, interface_c=round(kept_c), follow_mm=0.0))


class WholeFile(NamedTuple):
    """A file planned with all of it known."""

    found: OfflinePlan
    plain: OfflinePlan  # at the file's own speed
    settings: Settings  # with the interface that is held


def plan_whole(settings: Settings, run: Callable[[Settings], OfflinePlan]) -> WholeFile:
    """Once to see what the file is like, once more to see what its pace makes of that, and then for good; less if the
    config says how. `run` plans the file."""
    plain = run(replace(settings, slowest=1.0, longest_pause_s=0.0))
    paces = settings.slowest < 1.0 or settings.longest_pause_s > 0.0
    if settings.options.follow_mm > 0.0 and plain.moves:
        paced = run(settings) if paces else plain
        settings = steady(settings, plain.summary, paced.summary)
        return WholeFile(run(settings), plain, settings)
    return WholeFile(run(settings) if paces else plain, plain, settings)


class Planning:
    """Plans one file; `progress(lines)` is called now and then."""

    def __init__(
        self,
        settings: Settings,
        nozzle: NozzleLimits,
        limits: Limits,
        arc_mm: float = 1.0,
        other_nozzles: frozenset[int] = frozenset(),
    ) -> None:
        self._settings = settings
        self._nozzle = nozzle
        self._path = GcodePath(limits, arc_mm, other_nozzles, nozzle.max_c + HEADROOM_C)
        self._pacer = Pacer(settings.slowest, settings.longest_pause_s)
        self._paces: list[PaceChange] = []
        self._paced_s = 0.0
        self._fan = 0.0
        self._pieces = PathPieces(math.pi / 4.0 * settings.options.filament_mm**2)
        self._plan: TemperaturePlan | None = None
        self._owners: list[tuple[TimedMove, int, int]] = []  # (move, its layer, pieces that are laid)
        self._rows: list[Laid] = []  # of moves not yet whole
        self._moves: list[PlannedMove] = []
        self._corners: list[tuple[float, float]] = []
        self._base_c = 0.0
        self._end_s = self._planned_s = -math.inf

    def run(self, path: Path, base_c: float, progress: Callable[[int], None]) -> OfflinePlan:
        """`base_c`: nozzle temperature where the file names none. Raises OSError."""
        self._base_c = base_c
        for batch in self._path.moves(path):
            self._take(batch)
            if self._pacer.is_used and self._plan is not None:
                self._keep_pace()
            progress(self._path.lines)
        self._make(math.inf)
        plan = self._planner()
        self._book(math.inf)
        corners = np.array(self._corners or [(0.0, base_c)])
        duration_s = max(0.0, self._end_s)
        facts = duration_s, self._base_c, self._paces, self._path.other_tool_line
        return OfflinePlan(self._moves, corners, plan.summary(), *facts)

    def _keep_pace(self) -> None:
        """A layer begins (or, in a file that tells none, has about been laid): how fast may it come?"""
        plan, path, pacer = self._planner(), self._path, self._pacer
        if path.has_layers:
            if not path.layer_begins:
                return
        elif not pacer.is_round(plan.ages(), self._end_s - self._paced_s):
            return
        facts, before = self._pieces.facts(), pacer.pace
        place = Place(facts.z_mm, facts.height_mm, self._fan)
        # Without a known interface this run only measures what the window reaches: no allowance for the bed.
        pace = pacer.layer(plan.ages(), plan.interface_c, self._settings.material, self._around(), place)
        self._paced_s = self._end_s
        path.set_pace(pace.factor)
        if not path.has_layers:
            pace = Pace(pace.factor)
        elif pace.pause_s > 0.0:
            path.pause(pace.pause_s)
        if pace.factor != before.factor or pace.pause_s > 0.0:
            self._paces.append(PaceChange(path.lines - 1, pace))

    def _around(self) -> Surroundings:
        around, bed_c = self._settings.surroundings, self._path.bed_c
        return around if math.isnan(bed_c) else replace(around, bed_c=bed_c)

    def _planner(self) -> TemperaturePlan:
        """Made when the first path comes: by then the file has told its bed."""
        if self._plan is None:
            settings = self._settings
            self._plan = TemperaturePlan(self._nozzle, settings.material, self._around(), settings.options)
        return self._plan

    def _take(self, moves: Sequence[TimedMove]) -> None:
        """Add them, and plan when enough has come."""
        window_s = math.inf
        for timed in moves:
            self._add(timed)
            window_s = min(window_s, timed.move.print_time)
            if self._end_s - window_s >= WINDOW_S:
                self._make_if_due()
                window_s = math.inf
        self._make_if_due()

    def _add(self, timed: TimedMove) -> None:
        if timed.nozzle_c > 0.0:
            self._base_c = timed.nozzle_c
        wishes, table, self._fan = timed.wishes, self._settings.table, timed.fan

        def ask(time_s: float, layer: int, z_mm: float) -> Asked:
            wish_c = wishes.wish_c(table, time_s, layer, z_mm)
            by_place = bool(table.layers or table.heights_mm)
            return Asked(wish_c, self._base_c, wishes.height_mm, wishes.pace, by_place=by_place)

        pieces, plan = self._pieces, self._planner()
        before = pieces.facts().laid
        pieces.note([timed.move], timed.fan)
        facts = pieces.facts()
        if self._planned_s == -math.inf and facts.waiting:
            self._planned_s = facts.next_s
        pieces.feed(ask, plan.take)
        facts = pieces.facts()
        self._end_s = facts.end_s
        if facts.laid > before:
            layer = wishes.layer or int(facts.layer)  # of a vase only the slicer tells where one ends
            self._owners.append((timed, layer, int(facts.laid - before)))

    def _make_if_due(self) -> None:
        if self._end_s - self._planned_s >= AHEAD_S + WINDOW_S:
            self._make(self._end_s - AHEAD_S)

    def _make(self, until_s: float) -> None:
        """Plan from where the last plan is settled; it is settled up to `until_s` then."""
        plan = self._planner()
        from_s = self._planned_s
        if not from_s < self._end_s:
            return
        start_c = plan.at(from_s, self._base_c)
        corners = plan.make(from_s, start_c)
        self._corners += [corner for corner in corners if from_s <= corner[0] < until_s]
        self._planned_s = min(until_s, self._end_s)
        self._book(self._planned_s - 0.5)

    def _book(self, until_s: float) -> None:
        while rows := self._planner().finish(until_s, BOOK_ROWS):
            self._note(rows)

    def _note(self, rows: Sequence[Laid]) -> None:
        """Moves whose pieces are all booked."""
        self._rows += rows
        at = done = 0
        for timed, layer, count in self._owners:
            if at + count > len(self._rows):
                break
            self._moves.append(_planned(timed, layer, self._rows[at : at + count]))
            at += count
            done += 1
        del self._rows[:at], self._owners[:done]


def _planned(timed: TimedMove, layer: int, part: Sequence[Laid]) -> PlannedMove:
    def mean(name: str) -> float:
        return sum(getattr(row, name) for row in part) / len(part)

    move = timed.move
    names = ("wall_c", "melt_c", "substrate_c", "interface_c", "interface_fixed_c")
    place = (move.start_pos[:3], move.end_pos[:3], move.print_time)
    wall_c, melt_c, substrate_c, interface_c, fixed_c = map(mean, names)
    pace = timed.wishes.pace
    return PlannedMove(timed.line, layer, *place, wall_c, melt_c, substrate_c, interface_c, fixed_c, pace)
