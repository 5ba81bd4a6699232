"""Look-ahead: from a row of straight moves to the speeds at which each is entered, run and left.

All speeds are handled as squares, because under constant acceleration the square of the speed changes linearly with
the distance: v1^2 = v0^2 + 2*a*d.

Two limits act on a row of moves.

1. *Junctions.* Between two moves the speed is limited by the corner (see `corner_v2`). Going backwards from the end,
   where the head must be able to stop, each move may be entered only so fast that the rest can still be braked.

2. *Smoothing* (minimum_cruise_ratio). The same calculation with a lower, virtual acceleration gives a second speed
   profile: hills with valleys between them. The top of a hill caps the speed of every move that belongs to it, so
   short zigzags do not race and brake; the moves still use the full acceleration below that cap. On the way down
   from the top no move speeds up again.

            .--.  top: cap for the hill           ____  real profile, cut off at the cap
           /    \\        .-.                     /    \\
          /      \\      /   \\                   /      \\
         /        \\____/     \\                 /        \\
       valley      valley
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from toolhead import ToolHead

# Moves without a distance the planner cares about: the acceleration of pure extruder moves comes from the extruder.
UNLIMITED_ACCEL = 99999999.9
# Junction angles this close to straight or to full reversal are treated as such: the formulas divide by them.
ANGLE_EPSILON = 1e-9
# A motion this short is no motion: far below any step.
MIN_DISTANCE_MM = 1e-9


class Coord(NamedTuple):
    """A position: x, y, z and extruder, mm."""

    x: float
    y: float
    z: float
    e: float


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

    def __init__(
        self, toolhead: ToolHead, start_pos: Sequence[float], end_pos: Sequence[float], speed: float
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
        move_d = math.sqrt(dx * dx + dy * dy + dz * dz)
        if move_d >= MIN_DISTANCE_MM:
            self.is_kinematic_move = True
            self.end_pos = (end_pos[0], end_pos[1], end_pos[2], end_pos[3])
            if speed > toolhead.max_velocity:
                speed = toolhead.max_velocity
            inverse = 1.0 / move_d
        else:  # the extruder alone
            self.is_kinematic_move = False
            self.end_pos = (start_pos[0], start_pos[1], start_pos[2], end_pos[3])
            dx = dy = dz = 0.0
            move_d = abs(de)
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

    def follow(self, prev: Move, extruder_v2: float) -> None:
        """Set the highest entry speed after `prev`; extruder_v2 is the extruder's own limit for the junction."""
        limit = min(prev.max_cruise_v2, self.max_cruise_v2, prev.max_start_v2 + prev.delta_v2, extruder_v2)
        corner = corner_v2(prev, self)
        if corner < limit:
            limit = corner
        self.max_start_v2 = limit
        self.max_smoothed_v2 = min(limit, prev.max_smoothed_v2 + prev.smooth_delta_v2)

    def set_junction(self, start_v2: float, cruise_v2: float, end_v2: float) -> None:
        """Fix the speeds; works out the three times."""
        per_v2 = 0.5 / self.accel
        accel_d = (cruise_v2 - start_v2) * per_v2
        decel_d = (cruise_v2 - end_v2) * per_v2
        cruise_d = self.move_d - accel_d - decel_d
        self.start_v = start_v = math.sqrt(start_v2)
        self.cruise_v = cruise_v = math.sqrt(cruise_v2)
        self.end_v = end_v = math.sqrt(end_v2)
        self.accel_t = accel_d / ((start_v + cruise_v) * 0.5)
        self.cruise_t = cruise_d / cruise_v if cruise_d > 0.0 else 0.0
        self.decel_t = decel_d / ((end_v + cruise_v) * 0.5)


def corner_v2(prev: Move, move: Move) -> float:
    """Highest squared speed through the corner between two moves; infinite if it does not bend.

    Next to a move of the extruder alone the head stands still: 0.

    A circle is laid into the corner, touching both lines, and run at the speed whose centripetal acceleration is
    allowed: v^2 = a*R. With theta the angle between the lines (pi: straight on),
      - the circle that comes within `junction_deviation` of the corner has R = dev * s/(1-s), s = sin(theta/2);
      - the circle that touches the lines half a move away from the corner has R = d/2 * tan(theta/2)."""
    if not (prev.is_kinematic_move and move.is_kinematic_move):
        return 0.0
    ax, ay, az, _ = prev.axes_r
    bx, by, bz, _ = move.axes_r
    cos_theta = -(ax * bx + ay * by + az * bz)
    if cos_theta > 1.0 - ANGLE_EPSILON:  # back on itself
        return 0.0
    half = 0.5 * (1.0 - cos_theta)  # sin^2(theta/2)
    if half > 1.0 - ANGLE_EPSILON:  # straight on
        return math.inf
    sin_half = math.sqrt(half)
    tangent_v2 = 0.5 * sin_half / math.sqrt(1.0 - half)  # per mm and unit acceleration
    deviation_v2 = sin_half / (1.0 - sin_half)
    return min(
        deviation_v2 * min(move.junction_deviation * move.accel, prev.junction_deviation * prev.accel),
        tangent_v2 * min(move.move_d * move.accel, prev.move_d * prev.accel),
    )


def _speed_profiles(moves: Sequence[Move]) -> tuple[list[float], list[float]]:
    """Entry speeds squared, real and smoothed, of every move and (0) of what follows the last."""
    count = len(moves)
    entry, smoothed = [0.0] * (count + 1), [0.0] * (count + 1)
    v2 = s2 = 0.0
    for i in range(count - 1, -1, -1):
        move = moves[i]
        v2 += move.delta_v2
        if v2 > move.max_start_v2:
            v2 = move.max_start_v2
        entry[i] = v2
        s2 += move.smooth_delta_v2
        if s2 > move.max_smoothed_v2:
            s2 = move.max_smoothed_v2
        smoothed[i] = s2
    return entry, smoothed


def _settled_count(moves: Sequence[Move], entry: Sequence[float], smoothed: Sequence[float]) -> int:
    """How many moves no later move can change any more.

    Those before a valley whose depth is set by the corner itself, in both profiles, and not by the need to brake.
    """
    for i in range(len(moves) - 1, 0, -1):
        move, prev = moves[i], moves[i - 1]
        at_corner = smoothed[i] >= move.max_smoothed_v2 and entry[i] >= move.max_start_v2
        if at_corner and smoothed[i] < smoothed[i - 1] + prev.smooth_delta_v2:
            return i
    return 0


def _run_downhill(
    moves: Sequence[Move], entry: Sequence[float], first: int, last: int, top_v2: float
) -> None:
    """Fix the moves first..last, the falling side of a hill: never faster than before."""
    cap = top_v2
    for i in range(first, last + 1):
        cap = min(cap, entry[i])
        moves[i].set_junction(cap, cap, min(entry[i + 1], cap))


def plan(moves: Sequence[Move], lazy: bool) -> int:
    """Fix the speeds of moves at the front of the row; all of them unless `lazy`. Returns how many."""
    entry, smoothed = _speed_profiles(moves)
    count = _settled_count(moves, entry, smoothed) if lazy else len(moves)
    top_v2 = 0.0
    falling_end = -1  # last move of a falling side whose top is not reached yet
    for i in range(count - 1, -1, -1):
        move = moves[i]
        reachable = smoothed[i + 1] + move.smooth_delta_v2
        if smoothed[i] >= reachable:  # braking through: belongs to a falling side
            if falling_end < 0:
                falling_end = i
            continue
        if falling_end >= 0 or smoothed[i] + move.smooth_delta_v2 > smoothed[i + 1]:
            top_v2 = min(move.max_cruise_v2, 0.5 * (smoothed[i] + reachable))
            if falling_end >= 0:
                _run_downhill(moves, entry, i + 1, falling_end, top_v2)
                falling_end = -1
        start_v2, end_v2 = entry[i], entry[i + 1]
        cruise_v2 = min(0.5 * (start_v2 + end_v2 + move.delta_v2), move.max_cruise_v2, top_v2)
        move.set_junction(min(start_v2, cruise_v2), cruise_v2, min(end_v2, cruise_v2))
    return count


class LookAheadQueue:
    """Moves whose speeds are not fixed yet."""

    # Try to fix moves whenever this much (least) motion time has come in.
    REVIEW_S = 0.250

    def __init__(self) -> None:
        self.queue: list[Move] = []
        self._until_review_s = self.REVIEW_S

    def reset(self) -> None:
        """Forget everything."""
        self.queue.clear()
        self._until_review_s = self.REVIEW_S

    def get_last(self) -> Move | None:
        return self.queue[-1] if self.queue else None

    def flush(self, lazy: bool = False) -> list[Move]:
        """Take out the moves that are settled (all of them unless lazy)."""
        self._until_review_s = self.REVIEW_S
        count = plan(self.queue, lazy)
        settled = self.queue[:count]
        del self.queue[:count]
        return settled

    def add_move(self, move: Move, extruder: Any) -> bool:
        """Queue a move; True if it is time for a lazy flush."""
        queue = self.queue
        if queue:
            prev = queue[-1]
            move.follow(prev, extruder.calc_junction(prev, move))
        queue.append(move)
        self._until_review_s -= move.min_move_t
        return self._until_review_s <= 0.0
