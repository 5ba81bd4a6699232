"""Where in a G-code file a print stopped: the place of the head is looked for on the moves after a checkpoint.

    checkpoint (byte, modes, place) ─► moves() ─► locate(place by the steps made) ─► Place (line, point on its move)

The search is in space, not in time: it needs no clock. Two possible places are a refusal.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

MOVES_MAX = 20_000  # after the checkpoint: more than minutes of any print
CORNER = 4.0  # places on the path this many tolerances apart are two places
HEIGHT_MM = 0.02  # less than any layer

_WORD = re.compile(r"([A-Z])\s*([-+]?[0-9]*\.?[0-9]+)")
# Lines without motion of the head; RECOVER_PRINT runs those between the checkpoint and the stop again.
HARMLESS = frozenset(
    [
        "M73",
        "M104",
        "M106",
        "M107",
        "M109",
        "M117",
        "M118",
        "M140",
        "M190",
        "M204",
        "M400",
        "G4",
        "G21",
        "SET_PRESSURE_ADVANCE",
        "SET_VELOCITY_LIMIT",
        "SET_PRINT_STATS_INFO",
        "EXCLUDE_OBJECT_DEFINE",
        "EXCLUDE_OBJECT_START",
        "EXCLUDE_OBJECT_END",
    ]
)
_MODES = frozenset(["G90", "G91", "M82", "M83", "G92", "M220", "M221"])


class Refusal(Exception):
    """Why a print cannot be resumed."""


@dataclass(slots=True)
class State:
    """Modal state of G-code, as gcode_move has it; positions are x, y, z, e of the head (mm)."""

    position: list[float]
    base: list[float]
    homing: list[float]
    absolute_coord: bool
    absolute_extrude: bool
    speed: float
    speed_factor: float
    extrude_factor: float

    def copy(self) -> State:
        return replace(self, position=list(self.position), base=list(self.base))

    @property
    def velocity(self) -> float:
        return self.speed * self.speed_factor


@dataclass(frozen=True, slots=True)
class Segment:
    """One move of the file: where it begins, the state after it, and the byte at which the next line begins."""

    start: tuple[float, ...]
    state: State
    offset: int

    def at(self, share: float) -> tuple[float, ...]:
        return tuple(a + (b - a) * share for a, b in zip(self.start, self.state.position, strict=True))

    def min_s(self) -> float:
        """No printer makes the move in less time."""
        way = [b - a for a, b in zip(self.start, self.state.position, strict=True)]
        length = math.hypot(*way[:3]) or abs(way[3])
        return length / self.state.velocity if self.state.velocity > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class Place:
    """A point on a move."""

    segment: Segment
    point: tuple[float, ...]
    off_mm: float  # between the point and the head


@dataclass(frozen=True, slots=True)
class Tolerance:
    """The point may be this far from the head, and the filament that far from its place (mm)."""

    head_mm: float
    filament_mm: float


def _command(line: str) -> tuple[str, dict[str, float]]:
    text = line.partition(";")[0].strip().upper()
    name = text.split(" ", 1)[0]
    return name, {letter: float(value) for letter, value in _WORD.findall(text[len(name) :])}


def _apply_mode(state: State, name: str, words: dict[str, float]) -> None:
    if name in ("G90", "G91"):
        state.absolute_coord = name == "G90"
    elif name in ("M82", "M83"):
        state.absolute_extrude = name == "M82"
    elif name == "M220":
        state.speed_factor = words.get("S", 100.0) / 100.0
    elif name == "M221":
        factor = words.get("S", 100.0) / 100.0
        extruded = (state.position[3] - state.base[3]) / state.extrude_factor
        state.base[3], state.extrude_factor = state.position[3] - extruded * factor, factor
    elif not words:
        state.base = list(state.position)
    else:
        for axis, letter in enumerate("XYZE"):
            if letter in words:
                scale = state.extrude_factor if axis == 3 else 1.0
                state.base[axis] = state.position[axis] - words[letter] * scale


def _apply_move(state: State, words: dict[str, float]) -> None:
    if "F" in words:
        state.speed = words["F"] / 60.0
    for axis, letter in enumerate("XYZE"):
        if letter not in words:
            continue
        value = words[letter] * (state.extrude_factor if axis == 3 else 1.0)
        absolute = state.absolute_coord and (axis < 3 or state.absolute_extrude)
        state.position[axis] = value + (state.base if absolute else state.position)[axis]


def moves(text: bytes, offset: int, state: State, is_known: Callable[[str], bool]) -> Iterator[Segment]:
    """The moves of the lines of `text`, which begins at byte `offset`, up to a line that may move otherwise: a command
    that exists and is none of those above."""
    state = state.copy()
    yield Segment(tuple(state.position), state.copy(), offset)
    for line in text.splitlines(keepends=True):
        offset += len(line)
        name, words = _command(line.decode("utf-8", "replace"))
        start = tuple(state.position)
        if name in ("G0", "G1"):
            _apply_move(state, words)
            yield Segment(start, state.copy(), offset)
        elif name in _MODES:
            _apply_mode(state, name, words)
        elif name and name not in HARMLESS and is_known(name):
            return


def skipped(text: bytes) -> list[str]:
    """The lines without motion in it: what they set must be set again."""
    lines = text.decode("utf-8", "replace").splitlines()
    return [line for line in lines if _command(line)[0] in HARMLESS - {"G4", "M400"}]


def _nearest(segment: Segment, head: Sequence[float]) -> tuple[float, float, float]:
    """(share of the move, distance of the head, of the filament)."""
    way = [b - a for a, b in zip(segment.start, segment.state.position, strict=True)]
    axes = (0, 1, 2) if any(way[:3]) else (3,)
    length2 = sum(way[i] ** 2 for i in axes)
    share = sum(way[i] * (head[i] - segment.start[i]) for i in axes) / length2 if length2 else 0.0
    share = min(1.0, max(0.0, share))
    point = segment.at(share)
    return share, math.dist(point[:3], head[:3]), abs(point[3] - head[3])


def locate(segments: Iterable[Segment], head: Sequence[float], tolerance: Tolerance) -> Place:
    """The place on the path where the head and the filament are. Raises Refusal.

    The path may come back without having extruded meanwhile (a retraction and its end). Then the nearest place is
    taken, the first of equal ones: what is done twice deposits nothing."""
    way = list(islice(segments, MOVES_MAX))
    found: list[tuple[float, float, int, Place]] = []
    path_mm = 0.0
    for number, segment in enumerate(way):
        share, off_mm, filament_mm = _nearest(segment, head)
        length = math.dist(segment.start, segment.state.position)
        if off_mm <= tolerance.head_mm and filament_mm <= tolerance.filament_mm:
            place = Place(segment, segment.at(share), off_mm)
            found.append((math.hypot(off_mm, filament_mm), path_mm + share * length, number, place))
        path_mm += length
    if not found:
        raise Refusal(
            "the head is not on the path of the file's next moves (a macro, a pause or a shift moved it)"
        )
    first, last = found[0], found[-1]
    if last[1] - first[1] > CORNER * tolerance.head_mm + tolerance.filament_mm:
        e_max = max(segment.state.position[3] for segment in way[first[2] : last[2]])
        if e_max > head[3] + tolerance.filament_mm:
            raise Refusal("the path passes the place of the head more than once")
    return min(found, key=lambda entry: (round(entry[0], 6), entry[1]))[3]


def locate_flat(
    segments: Iterable[Segment], head: Sequence[float], span_s: float, tolerance: Tolerance
) -> Place:
    """The place on the path by X and Y alone: what the motors of Z and of the extruder did is not known. The head was
    stopped within `span_s` of the path's begin. Raises Refusal, also where filament or height are in doubt."""
    found: list[tuple[float, float, Place]] = []
    path_mm, time_s = 0.0, 0.0
    for segment in segments:
        way = [b - a for a, b in zip(segment.start, segment.state.position, strict=True)]
        length2 = way[0] ** 2 + way[1] ** 2
        along = sum(way[i] * (head[i] - segment.start[i]) for i in (0, 1))
        # without a way in X and Y both ends are places
        shares = [min(1.0, max(0.0, along / length2))] if length2 else [0.0, 1.0]
        for share in shares:
            point = segment.at(share)
            off_mm = math.dist(point[:2], head[:2])
            if off_mm <= tolerance.head_mm:
                found.append((off_mm, path_mm + share * math.hypot(*way), Place(segment, point, off_mm)))
        path_mm += math.hypot(*way)
        time_s += segment.min_s()
        if time_s > span_s:
            break
    if not found:
        raise Refusal("the head does not stand on the path of the file's next moves")
    best = min(found, key=lambda entry: (round(entry[0], 6), entry[1]))[2]
    if found[-1][1] - found[0][1] > CORNER * tolerance.head_mm + tolerance.filament_mm:
        raise Refusal("the path passes the place of the head more than once in the time in question")
    for _, _, place in found:
        if abs(place.point[3] - best.point[3]) > tolerance.filament_mm:
            raise Refusal("the extruder turned where the head stands, and how far is not known")
        if abs(place.point[2] - best.point[2]) > HEIGHT_MM:
            raise Refusal("the height changed where the head stands, and how far is not known")
    return best
