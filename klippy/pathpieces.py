"""Planned moves to pieces of path for the temperature plan: split, with flow and layer height.

Move (print_time, speeds) ─► up to `longest_mm` each, one extrusion rate per piece ─► tempplan.Piece
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from tempplan import Piece

HEIGHT_LEAST_MM, HEIGHT_MOST_MM = 0.05, 1.0
HEIGHT_FIRST_MM = 0.2  # before a second layer tells
SAME_Z_MM = 1e-3
TINY_S = 1e-6
PHASE_LEAST_S = 0.015  # a shorter move is one piece: the filament's compliance (20 ms) blurs its phases


@dataclass(slots=True)
class Layers:
    """Layers as the extruding path shows them."""

    number: int = 0
    z_mm: float = math.nan
    height_mm: float = HEIGHT_FIRST_MM
    _seen: list[float] = field(default_factory=list)

    def note(self, z_mm: float, told_mm: float = math.nan) -> float:
        """Material is laid at z; returns the layer's height. `told_mm`: what the slicer says, NaN if nothing."""
        if not abs(z_mm - self.z_mm) < SAME_Z_MM:
            step = z_mm - self.z_mm
            self.number = self.number + 1 if not step < 0.0 else 1  # down again: another object begins
            first = math.isnan(self.z_mm) or step < 0.0
            self.height_mm = min(HEIGHT_MOST_MM, max(HEIGHT_LEAST_MM, z_mm if first else step))
            self.z_mm = z_mm
        return self.height_mm if math.isnan(told_mm) else told_mm


# (print time of the piece's start, layer, z) -> (wish_c, base_c, layer height told or NaN, pace)
Asker = Callable[[float, int, float], tuple[float, float, float, float]]


class PathPieces:
    """Turns batches of moves into pieces."""

    def __init__(self, filament_area_mm2: float, longest_mm: float = 10.0) -> None:
        self.filament_area_mm2 = filament_area_mm2
        self.longest_mm = longest_mm
        self.layers = Layers()

    def pieces(self, moves: Sequence[Any], ask: Asker, fan: float = 0.0) -> Iterator[Piece]:
        """Pieces of moves whose times are fixed. Moves of the extruder alone lay nothing."""
        for move in moves:
            duration_s = move.accel_t + move.cruise_t + move.decel_t
            if duration_s <= TINY_S:
                continue
            flow = 0.0
            if move.is_kinematic_move and move.axes_d[3] > 0.0 and (move.axes_d[0] or move.axes_d[1]):
                flow = move.axes_d[3] * self.filament_area_mm2 / duration_s
            z_mm = move.end_pos[2]
            if flow <= 0.0:
                yield self._travel(move, duration_s, ask, fan)
                continue
            _, _, told_mm, _ = ask(move.print_time, self.layers.number, z_mm)
            height_mm = self.layers.note(z_mm, told_mm)
            wish_c, base_c, _, pace = ask(move.print_time, self.layers.number, z_mm)
            volume_mm3 = move.axes_d[3] * self.filament_area_mm2
            for from_s, to_s, a, b in self._parts(move):
                flow = volume_mm3 * (b - a) / (to_s - from_s)
                start, end = _between(move, a), _between(move, b)
                yield Piece(
                    move.print_time + from_s,
                    move.print_time + to_s,
                    start,
                    end,
                    flow,
                    height_mm,
                    fan,
                    wish_c,
                    base_c,
                    pace,
                )

    def _parts(self, move: Any) -> Iterator[tuple[float, float, float, float]]:
        """(from, to) in s after the start and in shares of the way: speeding up, cruise, braking, none too long."""
        time_s = way = 0.0
        phases = []
        for duration_s, speed in (
            (move.accel_t, 0.5 * (move.start_v + move.cruise_v)),
            (move.cruise_t, move.cruise_v),
            (move.decel_t, 0.5 * (move.cruise_v + move.end_v)),
        ):
            if duration_s > TINY_S:
                phases.append((duration_s, speed * duration_s / move.move_d))
        if sum(duration_s for duration_s, _ in phases) < PHASE_LEAST_S:
            phases = [(sum(p[0] for p in phases), sum(p[1] for p in phases))]
        for duration_s, share in phases:
            count = max(1, math.ceil(share * move.move_d / self.longest_mm))
            for _ in range(count):
                yield time_s, time_s + duration_s / count, way, way + share / count
                time_s += duration_s / count
                way += share / count

    def _travel(self, move: Any, duration_s: float, ask: Asker, fan: float) -> Piece:
        _, base_c, _, _ = ask(move.print_time, self.layers.number, move.end_pos[2])
        start, end = move.start_pos[:3], move.end_pos[:3]
        height_mm = self.layers.height_mm
        return Piece(
            move.print_time, move.print_time + duration_s, start, end, 0.0, height_mm, fan, math.nan, base_c
        )


def _between(move: Any, share: float) -> tuple[float, float, float]:
    """A place on the move (by path; the little that acceleration shifts it in time is left out)."""
    x, y, z = (a + share * (b - a) for a, b in zip(move.start_pos[:3], move.end_pos[:3], strict=True))
    return x, y, z
