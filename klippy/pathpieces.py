"""Planned moves to pieces of path for the temperature plan, in the C helper (chelper/tempplan_path.h).

look-ahead ─► note (a copy, nothing else) ... the plan's timer ─► feed: what is asked for by name, a stretch of path
                                                                  at a time ─► split pieces ─► tempplan
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import chelper


class Asked(NamedTuple):
    """What is asked for by name, true for all moves that begin before `until_s`; melt, nozzle degC, layer height mm.

    `by_place`: it depends on layer and height as well, and is asked for again where another layer begins.
    """

    wish_c: float = math.nan
    base_c: float = 0.0
    height_mm: float = math.nan  # told by the slicer; NaN: it is seen from the path
    pace: float = 1.0
    until_s: float = math.inf
    by_place: bool = False


# (print time of a move's start, layer, z) -> Asked
Asker = Callable[[float, int, float], Asked]
# (struct tempplan_piece *, how many)
Taker = Callable[[Any, int], None]


class PathPieces:
    """Moves that wait for the plan, and layers as the extruding path shows them."""

    def __init__(self, filament_area_mm2: float, longest_mm: float = 10.0) -> None:
        self._ffi, self._lib = chelper.get_ffi()
        path = self._lib.tempplan_path_alloc(filament_area_mm2, longest_mm)
        if path == self._ffi.NULL:
            raise MemoryError("no memory for the temperature plan")
        self._path = self._ffi.gc(path, self._lib.tempplan_path_free)
        self._facts = self._ffi.new("struct path_facts *")
        self._wish = self._ffi.new("struct path_wish *")
        self._pieces = self._ffi.new("struct tempplan_piece **")

    def note_planned(self, row: Any, count: int, print_time: float, fan: float) -> None:
        """The first `count` moves of the look-ahead's row; the first begins at `print_time`."""
        self._check(self._lib.tempplan_path_note_planned(self._path, row, count, print_time, fan))

    def note(self, moves: Sequence[Any], fan: float = 0.0) -> None:
        """Move objects (lookahead.Move) that have their print_time. Moves of the extruder alone lay nothing."""
        rows = self._ffi.new("struct path_move[]", len(moves))
        for row, move in zip(rows, moves, strict=True):
            row.start_s, row.distance_mm, row.fan = move.print_time, move.move_d, fan
            row.accel_s, row.cruise_s, row.decel_s = move.accel_t, move.cruise_t, move.decel_t
            row.start_v, row.cruise_v, row.end_v = move.start_v, move.cruise_v, move.end_v
            row.start_pos, row.end_pos = move.start_pos[:3], move.end_pos[:3]
            dx, dy, _, de = move.axes_d
            row.filament_mm = de if move.is_kinematic_move and de > 0.0 and (dx or dy) else 0.0
        self._check(self._lib.tempplan_path_note(self._path, rows, len(moves)))

    def feed(self, ask: Asker, take: Taker) -> None:
        """All that waits, as pieces, to `take`."""
        facts, wish = self.facts(), self._wish
        while facts.waiting:
            asked = ask(facts.next_s, int(facts.layer), facts.z_mm)
            wish.wish_c, wish.base_c, wish.height_mm, wish.pace, wish.until_s, wish.by_place = asked
            count = self._check(self._lib.tempplan_path_run(self._path, wish, self._pieces))
            if count:
                take(self._pieces[0], count)
            facts = self.facts()

    def drop(self, until_s: float = math.inf) -> None:
        """Forget what waits and ends by then."""
        self._lib.tempplan_path_drop(self._path, until_s)

    def facts(self) -> Any:
        """struct path_facts as it is now: next_s, end_s, layer, z_mm, height_mm, waiting, laid."""
        self._lib.tempplan_path_facts(self._path, self._facts)
        return self._facts

    def _check(self, status: int) -> int:
        if status < 0:
            raise MemoryError("no memory for the temperature plan")
        return status
