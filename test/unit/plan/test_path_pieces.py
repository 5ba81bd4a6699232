"""Moves of the look-ahead cut into pieces for the temperature plan."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest

import chelper
from path_rig import FILAMENT_MM2, LINES, collected
from thermal.plan.path_pieces import Asked, PathPieces
from thermal.plan.planner import Piece

PLAIN = Asked(base_c=240.0)


def taken(path: PathPieces, ask=lambda time_s, layer, z_mm: PLAIN) -> list[Piece]:  # type: ignore[no-untyped-def]
    """All pieces that it has."""
    pieces: list[Piece] = []

    ffi, lib = chelper.get_ffi()
    rows = ffi.new("struct tempplan_piece **")

    def take(waiting, request) -> int:  # type: ignore[no-untyped-def]
        count = lib.tempplan_path_run(waiting, request, rows)
        for row in ffi.unpack(rows[0], count) if count else ():
            place = tuple(row.start_pos), tuple(row.end_pos)
            rest = row.flow_mm3_s, row.height_mm, row.fan, row.request_c, row.base_c, row.speed_factor
            pieces.append(Piece(row.start_s, row.end_s, *place, *rest))
        return int(path.facts().waiting)

    path.feed(ask, take)
    return pieces


def test_pieces_hold_all_the_filament_and_all_the_time(tmp_path: Path) -> None:
    pieces = taken(collected(tmp_path, LINES).path)
    deposited = [p for p in pieces if p.flow_mm3_s > 0.0]
    assert sum(p.flow_mm3_s * (p.end_s - p.start_s) for p in deposited) == pytest.approx(8.0 * FILAMENT_MM2)
    assert max(math.dist(p.start_mm, p.end_mm) for p in deposited) <= 10.0 + 1e-9
    for a, b in itertools.pairwise(pieces):
        assert b.start_s - a.end_s == pytest.approx(0.0, abs=1e-9) or b.start_s - a.end_s == pytest.approx(
            0.5
        )
    slow, fast = min(p.flow_mm3_s for p in deposited), max(p.flow_mm3_s for p in deposited)
    assert (
        fast == pytest.approx(2.0 * FILAMENT_MM2 / 40.0 * 50.0) and slow < fast
    )  # cruise, and where it speeds up
    assert all(p.height_mm == pytest.approx(0.3) for p in deposited)


def test_layers_are_seen_where_material_is_deposited(tmp_path: Path) -> None:
    """A request by place is made again at each place: `seen` are the layers and heights it got."""
    heights = (0.3, 0.3, 0.5, 0.7, 0.9, 0.2, 0.4)
    text = "".join(f"G1 Z{z}\nG1 X{10 * (1 + i % 2)} E1 F600\n" for i, z in enumerate(heights))
    path = collected(tmp_path, f"M83\n{text}").path
    seen = []

    def ask(time_s: float, layer: int, z_mm: float) -> Asked:
        seen.append((layer, z_mm))
        return Asked(request_c=200.0 + layer, by_place=True)

    pieces = taken(path, ask)
    deposited = [p for p in pieces if p.flow_mm3_s > 0.0]
    at = {p.end_mm[2]: p for p in deposited}
    assert [at[z].height_mm for z in heights] == pytest.approx([0.3, 0.3, 0.2, 0.2, 0.2, 0.2, 0.2])
    assert [at[z].request_c for z in heights] == [
        201.0,
        201.0,
        202.0,
        203.0,
        204.0,
        201.0,
        202.0,
    ]  # 0.2: another object
    assert [z for _, z in seen[1:]] == pytest.approx([0.3, 0.5, 0.7, 0.9, 0.2, 0.4])
    again = collected(tmp_path, f"M83\n{text}").path
    given = taken(again, lambda t, layer, z: Asked(height_mm=0.15))
    assert {p.height_mm for p in given if p.flow_mm3_s > 0.0} == {0.15}  # the slicer knows better


def test_another_request_begins_with_the_first_move_that_starts_behind_its_mark(tmp_path: Path) -> None:
    text = "M83\n" + "".join(f"G1 X{10 * (i + 1)} E1 F600\n" for i in range(6))
    reader = collected(tmp_path, text)
    starts = [m.print_time for m in reader.moves]

    def ask(time_s: float, layer: int, z_mm: float) -> Asked:
        before = time_s < starts[3]
        return Asked(request_c=210.0 if before else 230.0, until_s=starts[3] if before else math.inf)

    pieces = taken(reader.path, ask)
    assert [p.request_c for p in pieces] == [210.0 if p.start_s < starts[3] - 1e-9 else 230.0 for p in pieces]
    assert {p.request_c for p in pieces} == {210.0, 230.0}


def test_what_has_been_deposited_unplanned_is_forgotten(tmp_path: Path) -> None:
    reader = collected(tmp_path, "M83\n" + "".join(f"G1 X{10 * (i + 1)} E1 F600\n" for i in range(6)))
    path, third_s = reader.path, reader.moves[2].print_time
    path.drop(third_s + 1e-9)
    assert path.facts().waiting == 4 and path.facts().next_s == third_s
    path.drop()
    assert not path.facts().waiting and math.isnan(path.facts().next_s)
