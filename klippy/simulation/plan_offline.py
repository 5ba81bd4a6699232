"""The temperature plan of a whole file, offline: the host's own path (path_host.py) and the printer's own session.

PathHost ─► PathEvents ─► Session ─► rows: what each move was planned to be, and its place on the part
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from extras.temperature_plan.path_events import PathEvents
from extras.temperature_plan.settings import Settings
from thermal.models.melt_exchange import NozzleLimits
from thermal.plan import weld
from thermal.plan.layer_time import LayerSpeed
from thermal.plan.planner import Deposited, Summary
from thermal.plan.session import COMMIT_S, RECORD_BEHIND_S, Session

from .path_host import PathHost

AHEAD_S = (
    2.0  # what is planned nearer than this to the end of the path as far as it is known is planned again
)
WINDOW_S = 2.0  # new motion until another plan
SHORTEST_S = 1e-6  # a shorter move deposits nothing (path_pieces.c)
FARTHEST_MM = 10000.0  # no printer is larger; the map of the part grows with its area
PROGRESS_LINES = 500


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """One extruding move: where, when, and its temperatures (degC, mean over the move)."""

    line: int
    layer: int  # as the file counts them; 0: it does not
    start_mm: tuple[float, float, float]
    end_mm: tuple[float, float, float]
    start_s: float  # from the first move on
    wall_c: float
    melt_c: float
    substrate_c: float
    interface_c: float
    interface_fixed_c: float
    speed_factor: float  # part of the file's own speed


class SpeedChange(NamedTuple):
    """Before this line of the file the print gets another speed, or waits."""

    line: int
    speed: LayerSpeed


@dataclass(frozen=True, slots=True)
class OfflinePlan:
    """The result for a file."""

    moves: list[PlannedMove]
    corners: np.ndarray  # (n, 2): s from the first move on, nozzle degC
    summary: Summary
    duration_s: float
    base_c: float
    speed_changes: list[SpeedChange]
    other_tool_line: int = -1  # where the file takes a tool with another nozzle first, from 0; -1: nowhere


def steady(settings: Settings, plain: Summary, slow_run: Summary) -> Settings:
    """The whole file is known: the weld is held at one temperature from the first road on.

    `plain`: the file at its own speed, whose fixed temperature gives the usual weld. `slow_run`: hot layers slowed,
    which shows what the window can still make of the ends of the path.
    """
    lowest_c = settings.options.interface_c or 0.0
    kept_c = weld.held_c(plain.interface_5_50_95_c[1][1], slow_run.band_c, lowest_c)
    return replace(settings, options=replace(settings.options, interface_c=round(kept_c), follow_mm=0.0))


class WholeFile(NamedTuple):
    """A file planned with all of it known."""

    found: OfflinePlan
    plain: OfflinePlan  # at the file's own speed
    settings: Settings  # with the interface that is held


def plan_whole(settings: Settings, run: Callable[[Settings], OfflinePlan]) -> WholeFile:
    """One run for the usual weld, one with hot layers slowed down, then the final one; fewer if the config fixes these.
    `run` plans the file."""
    plain = run(replace(settings, slowest=1.0, longest_pause_s=0.0))
    speed_changes = settings.slowest < 1.0 or settings.longest_pause_s > 0.0
    if settings.options.follow_mm > 0.0 and plain.moves:
        slow_run = run(settings) if speed_changes else plain
        settings = steady(settings, plain.summary, slow_run.summary)
        return WholeFile(run(settings), plain, settings)
    return WholeFile(run(settings) if speed_changes else plain, plain, settings)


class _Line(NamedTuple):
    """A line of the file, and what held for its moves."""

    number: int
    layer: int
    speed_factor: float


class _Road(NamedTuple):
    """An extruding move whose rows are still to come; print time."""

    line: _Line
    start_mm: tuple[float, float, float]
    end_mm: tuple[float, float, float]
    start_s: float


@dataclass(slots=True)
class _Lines:
    """Which line each move of the look-ahead comes from."""

    now: _Line
    over: deque[tuple[int, _Line]] = field(default_factory=deque)  # number of the first move behind it, line

    def of(self, number: int) -> _Line:
        while self.over and self.over[0][0] <= number:
            self.over.popleft()
        return self.over[0][1] if self.over else self.now


class OfflineRun(PathEvents):
    """Plans one file; `progress(lines)` is called now and then. As on a printer the session lags behind the lines
    read, here by as much as is good for the plan."""

    def __init__(
        self,
        settings: Settings,
        nozzle: NozzleLimits,
        base_c: float,
        progress: Callable[[int], None] = lambda lines: None,
    ) -> None:
        self._nozzle, self._progress = nozzle, progress
        # Without a known interface a run only measures what the window reaches: no allowance for the bed.
        allowance = settings.options.follow_mm <= 0.0
        self.session = Session(settings, nozzle, bed_allowance=allowance, keeps_rows=True)
        self.session.set_base(base_c)
        self._settings = settings
        self._lines = _Lines(_Line(0, 0, 1.0))
        self._roads: deque[_Road] = deque()
        self._rows: list[Deposited] = []  # of the first road
        self._moves: list[PlannedMove] = []
        self._corners: list[tuple[float, float]] = []
        self._speed_changes: list[SpeedChange] = []
        self._other_tool_line = -1
        self._begin_s = self._planned_s = math.nan  # of the path; settled up to then

    def run(self, config: Path, gcode: Path) -> OfflinePlan:
        """Raises OSError, or ValueError with the line that cannot be."""
        host = PathHost(config, gcode)
        super().__init__(host.printer, self._settings)
        self.enabled = True
        self.register_requests()
        self._gcode.register_command("TEMPERATURE_PLAN", lambda gcmd: None)
        host.run(self)
        self._settle(math.inf)
        self._collect(math.inf)
        corners = np.array(self._corners or [(0.0, self.session.target.base_c)])
        duration_s = max(0.0, self.session.lead.end_s - self._begin_s) if self._moves else 0.0
        summary, base_c = self.session.plan.summary(), self.session.target.base_c
        return OfflinePlan(
            self._moves, corners, summary, duration_s, base_c, self._speed_changes, self._other_tool_line
        )

    # The host's reader

    def on_ready(self, printer: Any) -> None:
        heaters = printer.lookup_object("heaters")
        name = self._settings.heater if self._settings.heater in heaters.heaters else "extruder"
        self.heater = heaters.lookup_heater(name)
        self.min_extrude_c = self._nozzle.min_extrude_c
        self.find_devices()
        self.listen()
        VolumetricE(printer)

    def before_line(self, number: int) -> None:
        self._lines.now = _Line(number, self.session.requested.state.layer, self.session.speed_factor)
        if number % PROGRESS_LINES == 0:
            self._progress(number)

    def after_line(self) -> None:
        lines, row = self._lines, self._toolhead.lookahead.row
        if not lines.over or lines.over[-1][0] != row.next:
            lines.over.append((row.next, lines.now))
        if max(map(abs, self._toolhead.commanded_pos[:3])) > FARTHEST_MM:
            raise ValueError("there is no printer so large")
        self._watch_heaters()
        self._watch_tool()
        end_s = self.session.path.facts().end_s
        if end_s - self._planned_s >= AHEAD_S + WINDOW_S:
            self._settle(end_s - AHEAD_S)

    def _watch_heaters(self) -> None:
        """Off at the end of a file: nothing is deposited any more."""
        target_c = self.heater.get_temp(0.0)[1]
        if target_c > 0.0 and target_c != self.session.target.base_c:
            self.session.take()
            self.session.set_base(target_c)
        self.watch_bed(0.0)

    def _watch_tool(self) -> None:
        serving = self._toolhead.get_extruder()
        other = serving.get_name() and serving.get_heater() is not self.heater
        if other and self._other_tool_line < 0:
            self._other_tool_line = self._lines.now.number

    # Path

    def _on_moves(self, row: Any, count: int, print_time: float) -> None:
        super()._on_moves(row, count, print_time)
        if not self._is_ours:
            return
        if math.isnan(self._begin_s):
            self._begin_s = self._planned_s = print_time
        for number in range(row.first, row.first + count):
            move = row.ring[number & row.mask]
            duration_s = move.accel_t + move.cruise_t + move.decel_t
            dx, dy, _, de = move.axes_d
            if de > 0.0 and (dx or dy) and duration_s > SHORTEST_S:
                start_mm, end_mm = tuple(move.start_pos[0:3]), tuple(move.end_pos[0:3])
                self._roads.append(_Road(self._lines.of(number), start_mm, end_mm, print_time))
            print_time += duration_s

    def begin_layer(self) -> None:
        self.session.take()
        super().begin_layer()

    def on_speed(self, speed: LayerSpeed) -> None:
        if not self.session.requested.state.layer:
            speed = LayerSpeed(speed.factor)  # no pause in the middle of a layer
        before = self._speed_changes[-1].speed.factor if self._speed_changes else 1.0
        if speed.factor != before or speed.pause_s > 0.0:
            self._speed_changes.append(SpeedChange(self._lines.now.number, speed))

    # Plan

    def _settle(self, until_s: float) -> None:
        """Plan from where the last plan is settled; it is settled up to `until_s` then."""
        session, from_s = self.session, self._planned_s
        if not from_s < session.path.facts().end_s:
            return
        turn = session.replan(from_s - COMMIT_S)
        if turn.reference is not None:
            corners = zip(turn.reference.times_s, turn.reference.temps_c, strict=True)
            self._corners += [(s - self._begin_s, c) for s, c in corners if from_s <= s < until_s]
        self._planned_s = min(until_s, session.lead.end_s)
        self._collect(self._planned_s - RECORD_BEHIND_S)
        if session.is_round():
            self.choose_speed()

    def _collect(self, until_s: float) -> None:
        """Rows to the roads they belong to."""
        self.session.record(until_s)
        roads = self._roads
        for row in self.session.take_rows():
            while len(roads) > 1 and roads[1].start_s <= row.start_s:
                self._close_road()
            self._rows.append(row)
        if math.isinf(until_s) and roads:
            self._close_road()

    def _close_road(self) -> None:
        road, rows = self._roads.popleft(), self._rows
        self._rows = []
        if rows:
            self._moves.append(_planned(road, road.start_s - self._begin_s, rows))


def _planned(road: _Road, start_s: float, rows: Sequence[Deposited]) -> PlannedMove:
    def mean(name: str) -> float:
        return sum(getattr(row, name) for row in rows) / len(rows)

    names = ("wall_c", "melt_c", "substrate_c", "interface_c", "interface_fixed_c")
    wall_c, melt_c, substrate_c, interface_c, fixed_c = map(mean, names)
    line, temps = road.line, (wall_c, melt_c, substrate_c, interface_c, fixed_c)
    return PlannedMove(
        line.number, line.layer, road.start_mm, road.end_mm, start_s, *temps, line.speed_factor
    )


class VolumetricE:
    """M200 D<diameter>: E counts mm³ from then on, as firmware has it that the file may be for; D0: mm again."""

    def __init__(self, printer: Any) -> None:
        self._gcode = printer.lookup_object("gcode")
        self._modes = printer.lookup_object("gcode_move")
        self._mm_per_e = 1.0
        if self._gcode.get_handler("M200") is None:
            self._gcode.register_command("M200", self.cmd_M200)
            self._flow = self._gcode.register_command("M221", None)
            self._gcode.register_command("M221", self.cmd_M221)

    def cmd_M200(self, gcmd: Any) -> None:
        diameter_mm = gcmd.get_float("D", 0.0, minval=0.0)
        percent = 100.0 * self._modes.modes.extrude_factor / self._mm_per_e
        self._mm_per_e = 4.0 / (math.pi * diameter_mm**2) if diameter_mm else 1.0
        self._set_percent(percent)

    def cmd_M221(self, gcmd: Any) -> None:
        self._set_percent(gcmd.get_float("S", 100.0, above=0.0))

    def _set_percent(self, percent: float) -> None:
        params = {"S": percent * self._mm_per_e}
        self._flow(self._gcode.create_gcode_command("M221", "M221", params))
