"""A G-code file as timed path, without a printer: the project's own look-ahead on the limits of a printer.cfg.

    lines ─► modal state ─► Move ─► look-ahead ─► moves with print times, and the line each came from

For planning offline. Homing, probing and macros take no time here; what a slicer writes between moves is understood as
far as it changes the path or its temperatures.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from extras import gcode_arcs
from gcode_command import CommandError
from lookahead import LookAheadQueue, Move
from motionlimits import RIGHT_ANGLE_FACTOR
from thermal.plan.requests import Wishes, read_comment

_NUMBERED = re.compile(r"N\d+\s*(.*?)(?:\*\s*\d+\s*)?$")
# The command and its parameters; blanks between them are no matter (G1X10).
_LINE = re.compile(r"([A-Z]\d+(?:\.\d+)?|[A-Z_][A-Z0-9_]*)\s*(.*)")
_WORD = re.compile(r"([A-Z])\s*([-+]?(?:\d+\.?\d*|\.\d+))")
_PARAMETER = re.compile(r"([A-Z_]+)=(\S+)")
BATCH_MOVES = 500
FARTHEST_MM = 10000.0  # no printer is larger; the map of the part grows with its area


@dataclass(slots=True)
class Limits:
    """What the look-ahead asks of a toolhead. mm, s."""

    max_velocity: float
    max_accel: float
    square_corner_velocity: float = 5.0
    minimum_cruise_ratio: float = 0.5
    instant_corner_v: float = 1.0

    @property
    def junction_deviation(self) -> float:
        return self.square_corner_velocity**2 * RIGHT_ANGLE_FACTOR / self.max_accel

    @property
    def max_accel_to_decel(self) -> float:
        return self.max_accel * (1.0 - self.minimum_cruise_ratio)

    def calc_junction(self, before: Move, move: Move) -> float:
        """Highest squared speed at which the filament's own speed jumps by no more than instant_corner_v."""
        change = move.axes_r[3] - before.axes_r[3]
        return move.max_cruise_v2 if abs(change) < 1e-9 else (self.instant_corner_v / change) ** 2


@dataclass(frozen=True, slots=True)
class TimedMove:
    """A move whose `print_time` is known, what was asked for there, and its line in the file (from 0)."""

    move: Move
    wishes: Wishes
    nozzle_c: float  # newest M104/M109
    fan: float
    line: int


@dataclass(slots=True)
class _Modes:
    absolute: bool = True
    absolute_e: bool = True
    speed_mm_s: float = 25.0
    speed_factor: float = 1.0
    extrude_factor: float = 1.0
    mm_per_e: float = 1.0  # after M200 D, E counts mm³
    other_nozzle: bool = False  # another one is in use
    plane: gcode_arcs.Plane = gcode_arcs.PLANES["G17"]
    nozzle_c: float = 0.0
    fan: float = 0.0
    wishes: Wishes = field(default_factory=Wishes)


class GcodePath:
    """Reads one file. `bed_c`: newest bed target met; `lines`: read so far; `arc_mm`: longest chord of an arc.

    `other_nozzles`: numbers of the tools that have a nozzle of their own. What they lay is left out, their targets too.
    `hottest_c`: a file that heats beyond it is refused, as the printer would.
    """

    def __init__(
        self,
        limits: Limits,
        arc_mm: float = gcode_arcs.DEFAULT_RESOLUTION_MM,
        other_nozzles: frozenset[int] = frozenset(),
        hottest_c: float = math.inf,
    ) -> None:
        self.limits = limits
        self.hottest_c = hottest_c
        self.arc_mm = arc_mm
        self.other_nozzles = other_nozzles
        self.other_tool_line = -1  # where another nozzle comes into use first
        self.layer_begins = False  # the line read last begins a layer
        self.bed_c = math.nan
        self.lines = 0
        self._modes = _Modes()
        self._position = [0.0, 0.0, 0.0, 0.0]
        self._origin = [0.0, 0.0, 0.0, 0.0]
        self._time_s = 0.0
        self._queue = LookAheadQueue(limits)
        self._facts: list[tuple[Wishes, float, float, int]] = []  # of the moves in the queue
        self._ready: list[TimedMove] = []

    def moves(self, path: Path) -> Iterator[list[TimedMove]]:
        """Batches of moves in order of time; one ends before each layer: the caller may choose its pace then.

        Raises ValueError with the line that cannot be.
        """
        with path.open(encoding="utf-8-sig", errors="replace") as stream:
            for number, line in enumerate(stream):
                self.lines = number + 1
                self.layer_begins = False
                try:
                    self._take(line, number)
                except (ValueError, ArithmeticError, CommandError) as error:
                    raise ValueError(f"{path}, line {number + 1}: '{line.strip()[:60]}': {error}") from None
                if self.layer_begins or len(self._ready) >= BATCH_MOVES:
                    yield self._hand_out()
        self.layer_begins = False
        self._flush(lazy=False)
        yield self._hand_out()

    def set_pace(self, factor: float) -> None:
        """What is read from now on is laid at this part of the file's speed."""
        self._modes.wishes = replace(self._modes.wishes, pace=factor)

    def pause(self, time_s: float) -> None:
        """Rest after all that has been read."""
        self._flush(lazy=False)
        self._time_s += time_s

    @property
    def has_layers(self) -> bool:
        """Has the file told a layer by a comment?"""
        return self._modes.wishes.layer > 0

    def _hand_out(self) -> list[TimedMove]:
        ready, self._ready = self._ready, []
        return ready

    def _take(self, line: str, number: int) -> None:
        text = line.strip()
        if text.startswith(";"):
            found = read_comment(text)
            if found is not None:
                self._modes.wishes = self._since(self._modes.wishes.comment(found))
                self.layer_begins = found.kind == "layer"
            return
        text = text.partition(";")[0].upper()
        numbered = _NUMBERED.match(text)
        found_line = _LINE.match(numbered[1] if numbered else text)
        if found_line is None:
            return
        command, rest = found_line.groups()
        if command in ("G0", "G1", "G2", "G3"):
            words = {letter: float(value) for letter, value in _WORD.findall(rest)}
            if words.get("F", 0.0) > 0.0:
                self._modes.speed_mm_s = words["F"] / 60.0
            for end in self._ways(command, words):
                self._move(end, number)
            return
        if command[0] == "T" and command[1:].isdigit():
            self._use_tool(int(command[1:]), number)
            return
        handler = getattr(self, "_on_" + command.replace(".", "_").lower(), None)
        if handler is not None:
            handler({**dict(_WORD.findall(rest)), **dict(_PARAMETER.findall(rest))})

    def _use_tool(self, tool: int, line: int) -> None:
        self._modes.other_nozzle = tool in self.other_nozzles
        if self._modes.other_nozzle and self.other_tool_line < 0:
            self.other_tool_line = line

    def _since(self, wishes: Wishes) -> Wishes:
        """Wishes by duration count from the end of what is queued."""
        if math.isinf(wishes.duration_s) or wishes is self._modes.wishes:
            return wishes
        if wishes.explicit_c == self._modes.wishes.explicit_c:
            return wishes
        self._flush(lazy=False)
        return replace(wishes, since_s=self._time_s)

    def _ways(self, command: str, words: dict[str, float]) -> list[list[float]]:
        """Ends of the straight moves that a line stands for, x y z e in mm."""
        modes, start = self._modes, self._position
        end = list(start)
        for i, letter in enumerate("XYZE"):
            if letter in words:
                value = words[letter] * (modes.extrude_factor * modes.mm_per_e if letter == "E" else 1.0)
                absolute = modes.absolute and (letter != "E" or modes.absolute_e)
                end[i] = value + (self._origin[i] if absolute else start[i])
        if max(map(abs, end[:3])) > FARTHEST_MM:
            raise ValueError("there is no printer so large")
        plane = modes.plane
        centre = tuple(words.get("IJK"[axis], 0.0) for axis in (plane.first, plane.second))
        if command in ("G0", "G1") or not any(centre):
            return [end]
        points = gcode_arcs.arc_points(plane, start, end, centre, command == "G2", self.arc_mm)  # type: ignore[arg-type]  # a pair
        step_e = (end[3] - start[3]) / len(points)
        return [[*point, start[3] + step_e * number] for number, point in enumerate(points, 1)]

    def _move(self, end: list[float], number: int) -> None:
        modes, start = self._modes, self._position
        speed_mm_s = modes.speed_mm_s * modes.speed_factor
        if end[3] > start[3] and end[:2] != start[:2]:
            speed_mm_s *= modes.wishes.pace
        laid = [*end[:3], start[3]] if modes.other_nozzle else end
        move = Move(self.limits, start, laid, speed_mm_s)  # type: ignore[arg-type]  # its four limits
        self._position = end
        if not move.move_d:
            return
        self._facts.append((modes.wishes, modes.nozzle_c, modes.fan, number))
        if self._queue.add_move(move, self.limits):
            self._flush(lazy=True)

    def _flush(self, lazy: bool) -> None:
        moves = self._queue.flush(lazy)
        for move, facts in zip(moves, self._facts, strict=False):
            move.print_time = self._time_s
            self._time_s += move.accel_t + move.cruise_t + move.decel_t
            self._ready.append(TimedMove(move, *facts))
        del self._facts[: len(moves)]

    # Commands that change the path or its temperatures

    def _on_g90(self, words: dict[str, str]) -> None:
        self._modes.absolute = True

    def _on_g91(self, words: dict[str, str]) -> None:
        self._modes.absolute = False

    def _on_m82(self, words: dict[str, str]) -> None:
        self._modes.absolute_e = True

    def _on_m83(self, words: dict[str, str]) -> None:
        self._modes.absolute_e = False

    def _on_g92(self, words: dict[str, str]) -> None:
        values = {i: float(words[letter]) for i, letter in enumerate("XYZE") if letter in words}
        for i in values or range(4):
            factor = self._modes.extrude_factor * self._modes.mm_per_e if i == 3 else 1.0
            self._origin[i] = self._position[i] - values.get(i, 0.0) * factor

    def _on_g17(self, words: dict[str, str]) -> None:
        self._modes.plane = gcode_arcs.PLANES["G17"]

    def _on_g18(self, words: dict[str, str]) -> None:
        self._modes.plane = gcode_arcs.PLANES["G18"]

    def _on_g19(self, words: dict[str, str]) -> None:
        self._modes.plane = gcode_arcs.PLANES["G19"]

    def _on_m220(self, words: dict[str, str]) -> None:
        if float(words.get("S", 100.0)) > 0.0:
            self._modes.speed_factor = float(words.get("S", 100.0)) / 100.0

    def _on_m221(self, words: dict[str, str]) -> None:
        if float(words.get("S", 100.0)) > 0.0:
            before, self._modes.extrude_factor = (
                self._modes.extrude_factor,
                float(words.get("S", 100.0)) / 100.0,
            )
            shown = (self._position[3] - self._origin[3]) / before
            self._origin[3] = self._position[3] - shown * self._modes.extrude_factor

    def _on_m200(self, words: dict[str, str]) -> None:
        diameter_mm = float(words.get("D", 0.0))
        self._modes.mm_per_e = 4.0 / (math.pi * diameter_mm**2) if diameter_mm > 0.0 else 1.0

    def _on_g4(self, words: dict[str, str]) -> None:
        self._flush(lazy=False)
        self._time_s += 1e-3 * float(words.get("P", 0.0)) + float(words.get("S", 0.0))

    def _on_m104(self, words: dict[str, str]) -> None:
        other = int(words["T"]) in self.other_nozzles if "T" in words else self._modes.other_nozzle
        target_c = float(words.get("S", 0.0))
        if target_c <= 0.0 or other:  # off at the end of a file: nothing is laid any more
            return
        if target_c > self.hottest_c:
            raise ValueError(f"max_temp of the printer is {self.hottest_c:g} C")
        self._modes.nozzle_c = target_c

    _on_m109 = _on_m104

    def _on_m140(self, words: dict[str, str]) -> None:
        if float(words.get("S", 0.0)) > 0.0:
            self.bed_c = float(words["S"])

    _on_m190 = _on_m140

    def _on_m106(self, words: dict[str, str]) -> None:
        self._modes.fan = min(1.0, float(words.get("S", 255.0)) / 255.0)

    def _on_m107(self, words: dict[str, str]) -> None:
        self._modes.fan = 0.0

    def _on_m204(self, words: dict[str, str]) -> None:
        accel = float(words.get("S", words.get("P", 0.0)))
        if accel > 0.0:
            self.limits.max_accel = accel

    def _on_set_velocity_limit(self, words: dict[str, str]) -> None:
        if float(words.get("ACCEL", 0.0)) > 0.0:
            self.limits.max_accel = float(words["ACCEL"])

    def _on_m104_1(self, words: dict[str, str]) -> None:
        self._modes.wishes = self._modes.wishes.explicitly(float(words.get("S", 0.0)) or math.nan)

    def _on_set_segment_temperature(self, words: dict[str, str]) -> None:
        temp_c = float(words.get("TEMP", 0.0)) or math.nan
        until, duration_s = words.get("UNTIL", "").lower(), float(words.get("DURATION", math.inf))
        self._modes.wishes = self._since(self._modes.wishes.explicitly(temp_c, until, duration_s))

    def _on_exclude_object_start(self, words: dict[str, str]) -> None:
        self._modes.wishes = self._modes.wishes.inside(words.get("NAME", ""))

    def _on_exclude_object_end(self, words: dict[str, str]) -> None:
        self._modes.wishes = self._modes.wishes.inside("")


def read_limits(section: Any, extruder: Any) -> Limits:
    """From [printer] and [extruder] (ConfigWrapper each). Raises ConfigError."""
    return Limits(
        section.getfloat("max_velocity", 200.0, above=0.0),
        section.getfloat("max_accel", 2000.0, above=0.0),
        section.getfloat("square_corner_velocity", 5.0, minval=0.0),
        section.getfloat("minimum_cruise_ratio", 0.5, minval=0.0, below=1.0),
        extruder.getfloat("instantaneous_corner_velocity", 1.0, minval=0.0),
    )
