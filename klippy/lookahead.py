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
import struct
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import chelper
from gcode import Coord

__all__ = ["Coord", "LookAheadQueue", "Move", "done_in_c", "is_done_in_c"]

# Moves without a distance the planner cares about: the acceleration of pure extruder moves comes from the extruder.
UNLIMITED_ACCEL = 99999999.9
# A motion this short is no motion: far below any step.
MIN_DISTANCE_MM = 1e-9


# Fields of a Move that are single numbers in struct lookahead_move, too.
_PLAIN_FIELDS = (
    "move_d", "min_move_t", "accel", "junction_deviation", "max_cruise_v2", "delta_v2", "smooth_delta_v2",
    "max_start_v2", "max_smoothed_v2",
)  # fmt: skip


class Limits(Protocol):
    """What a move and the queue need of the toolhead (klippy/toolhead.py). mm, s."""

    printer: Any
    max_velocity: float
    max_accel: float
    max_accel_to_decel: float
    junction_deviation: float
    extra_axes: Any

    def get_max_velocity(self) -> tuple[float, float]: ...


class Move:
    """One straight move. Kinematics and extruder may slow it down (`limit_speed`) until it is queued.

    Distances mm, speeds mm/s (`_v2`: squared), times s.
    """

    __slots__ = (
        "accel",
        "accel_t",
        "axes_d",
        "axes_r",
        "cruise_t",
        "cruise_v",
        "decel_t",
        "delta_v2",
        "end_pos",
        "end_v",
        "extra_d",
        "is_kinematic_move",
        "junction_deviation",
        "max_cruise_v2",
        "max_smoothed_v2",
        "max_start_v2",
        "min_move_t",
        "move_d",
        "print_time",
        "smooth_delta_v2",
        "start_pos",
        "start_v",
        "timing_callbacks",
        "toolhead",
    )

    print_time: float  # of the start; set when the move is committed
    # set when it is planned
    start_v: float
    cruise_v: float
    end_v: float
    accel_t: float
    cruise_t: float
    decel_t: float

    def __init__(
        self, toolhead: Limits, start_pos: Sequence[float], end_pos: Sequence[float], speed: float
    ) -> None:
        self.toolhead = toolhead
        self.start_pos = (start_pos[0], start_pos[1], start_pos[2], start_pos[3])
        self.timing_callbacks: list[Callable[[float], None]] | None = None
        self.accel = toolhead.max_accel
        self.junction_deviation = toolhead.junction_deviation
        dx = end_pos[0] - start_pos[0]
        dy = end_pos[1] - start_pos[1]
        dz = end_pos[2] - start_pos[2]
        de = end_pos[3] - start_pos[3]
        self.extra_d = tuple(b - a for a, b in zip(start_pos[4:], end_pos[4:], strict=False))
        move_d = math.sqrt(dx * dx + dy * dy + dz * dz)
        if move_d >= MIN_DISTANCE_MM:
            self.is_kinematic_move = True
            self.end_pos = (end_pos[0], end_pos[1], end_pos[2], end_pos[3])
            if speed > toolhead.max_velocity:
                speed = toolhead.max_velocity
            inverse = 1.0 / move_d
        else:  # the extruder or further axes alone
            self.is_kinematic_move = False
            self.end_pos = (start_pos[0], start_pos[1], start_pos[2], end_pos[3])
            dx = dy = dz = 0.0
            move_d = max(abs(de), *map(abs, self.extra_d)) if self.extra_d else abs(de)
            self.accel = UNLIMITED_ACCEL
            inverse = 1.0 / move_d if move_d else 0.0
        self.move_d = move_d
        self.axes_d = (dx, dy, dz, de)
        self.axes_r = (dx * inverse, dy * inverse, dz * inverse, de * inverse)
        self.min_move_t = move_d / speed
        self.max_start_v2 = 0.0
        self.max_smoothed_v2 = 0.0
        self.max_cruise_v2 = speed * speed
        self.delta_v2 = 2.0 * move_d * self.accel
        self.smooth_delta_v2 = 2.0 * move_d * toolhead.max_accel_to_decel

    @classmethod
    def from_record(cls, toolhead: Limits, record: Any) -> Move:
        """The object of a move the C helper has made (struct lookahead_move)."""
        move = cls.__new__(cls)
        move.toolhead = toolhead
        move.timing_callbacks = None
        move.extra_d = ()
        move.start_pos, move.end_pos = tuple(record.start_pos), tuple(record.end_pos)
        move.axes_d, move.axes_r = tuple(record.axes_d), tuple(record.axes_r)
        move.is_kinematic_move = bool(record.is_kinematic_move)
        for name in _PLAIN_FIELDS:
            setattr(move, name, getattr(record, name))
        return move

    def limit_speed(self, speed: float, accel: float) -> None:
        """Slow the move down to at most this speed and acceleration along its path."""
        speed2 = speed * speed
        if speed2 < self.max_cruise_v2:
            self.max_cruise_v2 = speed2
            self.min_move_t = self.move_d / speed
        if accel < self.accel:
            self.accel = accel
        self.delta_v2 = 2.0 * self.move_d * self.accel
        if self.smooth_delta_v2 > self.delta_v2:
            self.smooth_delta_v2 = self.delta_v2

    def move_error(self, msg: str = "Move out of range") -> Exception:
        """An error for the user that names where the move wants to go."""
        x, y, z, e = self.end_pos
        return self.toolhead.printer.command_error(f"{msg}: {x:.3f} {y:.3f} {z:.3f} [{e:.3f}]")


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
    those that Python has made or asked for."""

    # Try to fix moves whenever this much (least) motion time has come in.
    REVIEW_S = 0.250
    # What a move brings along, in the order of struct lookahead_move.
    _PLANNED = struct.Struct("=24d")

    def __init__(self, toolhead: Any = None) -> None:
        self._toolhead = toolhead
        ffi, self._lib = chelper.get_ffi()
        self.row = ffi.gc(self._lib.lookahead_alloc(self.REVIEW_S), self._lib.lookahead_free)
        self._scratch = ffi.new("struct lookahead_move *")
        self._scratch_bytes = ffi.buffer(self._scratch)
        self._moves: dict[int, Move] = {}  # by number in the row

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
        last, record = self._move(self.row.next - 1), self._record(self.row.next - 1)
        last.max_cruise_v2 = min(record.max_cruise_v2, max(speed * speed, record.max_start_v2))
        record.max_cruise_v2 = last.max_cruise_v2

    def plan(self, lazy: bool = False) -> int:
        """Fix the speeds of the moves that are settled (all of them unless lazy); returns how many."""
        return self._lib.lookahead_plan(self.row, lazy)

    def take(self, count: int) -> list[Move]:
        """Take out the first moves, which are planned, as objects."""
        first = self.row.first
        moves = []
        for number in range(first, first + count):
            move, record = self._move(number), self._record(number)
            move.max_start_v2, move.max_smoothed_v2 = record.max_start_v2, record.max_smoothed_v2
            move.start_v, move.cruise_v, move.end_v = record.start_v, record.cruise_v, record.end_v
            move.accel_t, move.cruise_t, move.decel_t = record.accel_t, record.cruise_t, record.decel_t
            moves.append(move)
            del self._moves[number]
        self._lib.lookahead_drop(self.row, count)
        return moves

    def callbacks(self, count: int) -> list[tuple[int, list[Callable[[float], None]]]]:
        """(how many moves up to and with this one since the last, whom to tell its end) among the first `count`,
        whose objects are let go; the last pair closes the count."""
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
                    axis_v2 = self._toolhead.extra_axes[axis].calc_junction(before, move, axis)
                    extruder_v2 = min(extruder_v2, axis_v2)
        self._PLANNED.pack_into(
            self._scratch_bytes, 0, *move.start_pos, *move.end_pos, *move.axes_d, *move.axes_r, move.move_d,
            move.min_move_t, move.accel, move.junction_deviation, move.is_kinematic_move, move.max_cruise_v2,
            move.delta_v2, move.smooth_delta_v2,
        )  # fmt: skip
        self._moves[number] = move
        return self._lib.lookahead_add(self.row, self._scratch, extruder_v2) != 0
