"""Planned moves to pieces of path for the temperature plan, in the C helper (thermal/plan/path_pieces.h).

look-ahead ─► note_planned (a copy, nothing else) ... the plan's timer ─► feed: requests by name,
                                                             a stretch of path at a time ─► split pieces ─► tempplan
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import chelper


class Asked(NamedTuple):
    """Temperatures requested by name, for all moves that begin before `until_s`; degC, mm.

    `by_place`: they also depend on layer and height; each new layer is a new request.
    """

    request_c: float = math.nan
    base_c: float = 0.0
    height_mm: float = math.nan  # given by the slicer; NaN: it is seen from the path
    speed_factor: float = 1.0
    until_s: float = math.inf
    by_place: bool = False


NO_MEMORY = "no memory for the temperature plan"
# (print time of a move's start, layer, z) -> Asked
Asker = Callable[[float, int, float], Asked]
# (struct tempplan_path *, struct path_request *) -> moves that still wait; below 0: no memory
Taker = Callable[[Any, Any], int]


class PathPieces:
    """Moves that wait for the plan, and layers as the extruding path shows them."""

    def __init__(self, filament_area_mm2: float, longest_mm: float = 10.0) -> None:
        self._ffi, self._lib = chelper.get_ffi()
        path = self._lib.tempplan_path_alloc(filament_area_mm2, longest_mm)
        if path == self._ffi.NULL:
            raise MemoryError(NO_MEMORY)
        self.handle = self._ffi.gc(path, self._lib.tempplan_path_free)
        self.request = self._ffi.new("struct path_request *")  # what was asked for last
        self._facts = self._ffi.new("struct path_facts *")
        self._note_planned = self._lib.tempplan_path_note_planned
        self.forget()

    def note_planned(self, row: Any, count: int, print_time: float, fan: float, planned_s: float) -> bool:
        """The first `count` moves of the look-ahead's row; the first begins at `print_time`.

        True: enough moves wait beyond `planned_s` for another plan.
        """
        due = self._note_planned(self.handle, row, count, print_time, fan, planned_s)
        if due < 0:
            raise MemoryError(NO_MEMORY)
        return due > 0

    def forget(self, until_s: float = -math.inf) -> None:
        """The last request ends at this time."""
        self.request.until_s = min(self.request.until_s, until_s)

    def inquire(self, ask: Asker) -> None:
        """Get the request for the first move that waits."""
        facts, request = self.facts(), self.request
        asked = ask(facts.next_s, int(facts.layer), facts.z_mm)
        (
            request.request_c,
            request.base_c,
            request.height_mm,
            request.speed_factor,
            request.until_s,
            request.by_place,
        ) = asked

    def feed(self, ask: Asker, take: Taker) -> None:
        """Pass all waiting moves, as pieces, to `take`, with new requests."""
        self.forget()
        while self.check(take(self.handle, self.request)):
            self.inquire(ask)

    def drop(self, until_s: float = math.inf) -> None:
        """Forget waiting moves that end before this time."""
        self._lib.tempplan_path_drop(self.handle, until_s)

    def facts(self) -> Any:
        """struct path_facts as it is now: next_s, end_s, layer, z_mm, height_mm, waiting, deposited."""
        self._lib.tempplan_path_facts(self.handle, self._facts)
        return self._facts

    @staticmethod
    def check(status: int) -> int:
        """The status of a C call, unless it says that there is no memory."""
        if status < 0:
            raise MemoryError(NO_MEMORY)
        return status
