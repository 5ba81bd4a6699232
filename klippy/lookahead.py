"""Look-ahead: from a row of straight moves to the speeds at which each is entered, run and left.

All speeds are handled as squares, because under constant acceleration the square of the speed changes linearly with
the distance: v1^2 = v0^2 + 2*a*d.

Two limits act on a row of moves.

1. *Junctions.* Between two moves the speed is limited by the corner (`corner_v2` in lookahead.c). Going backwards
   from the end, where the head must be able to stop, each move may be entered only so fast that the rest can still be
   braked.

2. *Smoothing* (minimum_cruise_ratio). The same calculation with a lower, virtual acceleration gives a second speed
   profile: hills with valleys between them. The top of a hill caps the speed of every move that belongs to it, so
   short zigzags do not race and brake; the moves still use the full acceleration below that cap. On the way down
   from the top no move speeds up again.

            .--.  top: cap for the hill           ____  real profile, cut off at the cap
           /    \\        .-.                     /    \\
          /      \\      /   \\                   /      \\
         /        \\____/     \\                 /        \\
       valley      valley

The calculation is chelper/motion/lookahead.c; here are the moves as Python sees them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import chelper
from gcode import Coord
from motionlimits import MIN_SPEED, too_slow

__all__ = ["Coord", "LookAheadQueue", "Move", "done_in_c", "is_done_in_c"]


class Limits(Protocol):
    """What a move and the queue need of the toolhead (klippy/toolhead.py). mm, s."""

    printer: Any
    max_velocity: float
    max_accel: float
    max_accel_to_decel: float
    junction_deviation: float
    extra_axes: Any

    def get_max_velocity(self) -> tuple[float, float]: ...


def limits_of(toolhead: Limits) -> tuple[float, float, float, float]:
    """struct move_limits."""
    return (
        toolhead.max_velocity,
        toolhead.max_accel,
        toolhead.junction_deviation,
        toolhead.max_accel_to_decel,
    )


def _field(name: str, kind: Callable[[Any], Any] = float) -> Any:
    """An attribute that is a field of the C structure."""
    return property(
        lambda move: kind(getattr(move.record, name)),
        lambda move, value: setattr(move.record, name, value),
    )


class Move:
    """One straight move, as the C helper has it (struct lookahead_move in move.h). Kinematics and extruder may slow it
    down (`limit_speed`) until it is queued.

    Distances mm, speeds mm/s (`_v2`: squared), times s.
    """

    __slots__ = ("extra_d", "extra_start", "print_time", "record", "timing_callbacks", "toolhead")

    print_time: float  # of the start; set when the move is committed
    start_pos: tuple[float, float, float, float] = _field("start_pos", tuple)
    end_pos: tuple[float, float, float, float] = _field("end_pos", tuple)
    axes_d: tuple[float, float, float, float] = _field("axes_d", tuple)
    axes_r: tuple[float, float, float, float] = _field("axes_r", tuple)
    is_kinematic_move: bool = _field("is_kinematic_move", bool)
    move_d: float = _field("move_d")
    min_move_t: float = _field("min_move_t")
    accel: float = _field("accel")
    junction_deviation: float = _field("junction_deviation")
    max_cruise_v2: float = _field("max_cruise_v2")
    delta_v2: float = _field("delta_v2")
    smooth_delta_v2: float = _field("smooth_delta_v2")
    max_start_v2: float = _field("max_start_v2")
    max_smoothed_v2: float = _field("max_smoothed_v2")
    # set when it is planned
    start_v: float = _field("start_v")
    cruise_v: float = _field("cruise_v")
    end_v: float = _field("end_v")
    accel_t: float = _field("accel_t")
    cruise_t: float = _field("cruise_t")
    decel_t: float = _field("decel_t")

    def __init__(
        self, toolhead: Limits, start_pos: Sequence[float], end_pos: Sequence[float], speed: float
    ) -> None:
        if not speed >= MIN_SPEED:
            raise too_slow(speed)
        if not math.isfinite(sum(end_pos)):
            raise toolhead.printer.command_error(f"Move to a place that is no number: {tuple(end_pos)}")
        ffi, lib = chelper.get_ffi()
        self.toolhead = toolhead
        self.timing_callbacks: list[Callable[[float], None]] | None = None
        self.extra_d = tuple(b - a for a, b in zip(start_pos[4:], end_pos[4:], strict=False))
        self.extra_start = tuple(start_pos[4:])
        self.record = ffi.new("struct lookahead_move *")
        others_mm = max(map(abs, self.extra_d)) if self.extra_d else 0.0
        lib.move_fill(self.record, [limits_of(toolhead)], start_pos[:4], end_pos[:4], speed, others_mm)

    @classmethod
    def from_record(cls, toolhead: Limits, record: Any) -> Move:
        """The object of a move the C helper has made."""
        move = cls.__new__(cls)
        move.toolhead = toolhead
        move.timing_callbacks = None
        move.extra_d = move.extra_start = ()
        move.record = chelper.get_ffi()[0].new("struct lookahead_move *", record)
        return move

    def limit_speed(self, speed: float, accel: float) -> None:
        """Slow the move down to at most this speed and acceleration along its path."""
        chelper.get_ffi()[1].move_limit_speed(self.record, speed, accel)

    def move_error(self, msg: str = "Move out of range") -> Exception:
        """An error for the user that names the move's end."""
        x, y, z, e = self.end_pos
        return self.toolhead.printer.command_error(f"{msg}: {x:.3f} {y:.3f} {z:.3f} [{e:.3f}]")


class AllAxesMove:
    """A move as further axes see it: its vectors go on after x, y, z, e with theirs."""

    def __init__(self, move: Move) -> None:
        self._move = move

    def __getattr__(self, name: str) -> Any:
        return getattr(self._move, name)

    @property
    def start_pos(self) -> tuple[float, ...]:
        return (*self._move.start_pos, *self._move.extra_start)

    @property
    def end_pos(self) -> tuple[float, ...]:
        ends = zip(self._move.extra_start, self._move.extra_d, strict=False)
        return (*self._move.end_pos, *(start + way for start, way in ends))

    @property
    def axes_d(self) -> tuple[float, ...]:
        return (*self._move.axes_d, *self._move.extra_d)

    @property
    def axes_r(self) -> tuple[float, ...]:
        return (*self._move.axes_r, *(way / self._move.move_d for way in self._move.extra_d))


def done_in_c(method: Any) -> Any:
    """Mark a method whose work the C helper may do in its place (see gcode_rows.h).

    The mark is on the function: a subclass or plugin that puts another in its place is always called."""
    method.done_in_c = True
    return method


def is_done_in_c(*methods: Any) -> bool:
    """Whether all of them bear the mark."""
    return all(getattr(method, "done_in_c", False) for method in methods)


class LookAheadQueue:
    """Moves whose speeds are not fixed yet. They live in the C helper (lookahead.h); Move objects exist only for
    those that Python has made or requested."""

    # Try to fix moves whenever at least this much motion time has come in.
    REVIEW_S = 0.050

    def __init__(self, toolhead: Any = None) -> None:
        self._toolhead = toolhead
        ffi, self._lib = chelper.get_ffi()
        self.row = ffi.gc(self._lib.lookahead_alloc(self.REVIEW_S), self._lib.lookahead_free)
        self._moves: dict[int, Move] = {}  # by number in the row

    def set_flush_time(self, flush_time: float) -> None:
        """Plugins say how much motion to gather; a queue that reviews its moves every REVIEW_S has no use for it."""

    def __len__(self) -> int:
        return self.row.next - self.row.first

    @property
    def queue(self) -> list[Move]:
        """The waiting moves; to look at."""
        return [self._move(number) for number in range(self.row.first, self.row.next)]

    def reset(self) -> None:
        """Forget everything."""
        self._lib.lookahead_reset(self.row)
        self._moves.clear()

    def _record(self, number: int) -> Any:
        return self.row.ring[number & self.row.mask]

    def _move(self, number: int) -> Move:
        """The Move object of a waiting move."""
        move = self._moves.get(number)
        if move is None:
            move = self._moves[number] = Move.from_record(self._toolhead, self._record(number))
        return move

    def get_last(self) -> Move | None:
        return self._move(self.row.next - 1) if len(self) else None

    def limit_last_cruise(self, speed: float) -> None:
        """The last move goes no faster than this (mm/s), or than it is entered."""
        if not len(self):
            return
        record = self._record(self.row.next - 1)
        record.max_cruise_v2 = min(record.max_cruise_v2, max(speed * speed, record.max_start_v2))
        self._move(self.row.next - 1).record.max_cruise_v2 = record.max_cruise_v2

    def plan(self, lazy: bool = False) -> int:
        """Fix the speeds of the moves that are settled (all of them unless lazy); returns how many."""
        return self._lib.lookahead_plan(self.row, lazy)

    def planned(self, count: int) -> list[Move]:
        """The first moves, which are planned, as objects; the queue drops them."""
        first = self.row.first
        moves = []
        for number in range(first, first + count):
            move = self._move(number)
            move.record[0] = self._record(number)
            moves.append(move)
            del self._moves[number]
        return moves

    def take(self, count: int) -> list[Move]:
        """The same, taken out."""
        moves = self.planned(count)
        self._lib.lookahead_drop(self.row, count)
        return moves

    def callbacks(self, count: int) -> list[tuple[int, list[Callable[[float], None]]]]:
        """(moves up to and with this one since the last pair, callbacks of its end) among the first `count` moves,
        whose objects are dropped; the last pair completes the count."""
        pairs: list[tuple[int, list[Callable[[float], None]]]] = []
        at, end = self.row.first, self.row.first + count
        for number in sorted(n for n in self._moves if n < end):
            waiting = self._moves.pop(number).timing_callbacks
            if waiting is not None:
                pairs.append((number + 1 - at, waiting))
                at = number + 1
        pairs.append((end - at, []))
        return pairs

    def flush(self, lazy: bool = False) -> list[Move]:
        """Plan and take out the moves that are settled (all of them unless lazy)."""
        return self.take(self.plan(lazy))

    @done_in_c
    def add_move(self, move: Move, extruder: Any) -> bool:
        """Queue a move; True if it is time for a lazy flush."""
        number = self.row.next
        extruder_v2 = move.max_cruise_v2
        if number != self.row.first:
            before = self._move(number - 1)
            extruder_v2 = extruder.calc_junction(before, move)
            for axis, way in enumerate(move.extra_d):
                if way or before.extra_d[axis : axis + 1] not in ((), (0.0,)):
                    views = AllAxesMove(before), AllAxesMove(move)
                    axis_v2 = self._toolhead.extra_axes[axis].calc_junction(*views, 4 + axis)
                    extruder_v2 = min(extruder_v2, axis_v2)
        self._moves[number] = move
        return self._lib.lookahead_add(self.row, move.record, extruder_v2) != 0
