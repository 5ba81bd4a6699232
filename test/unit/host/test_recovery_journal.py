"""The file of [print_recovery] and the search for a place on the path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from extras.recovery.journal import SLOT_BYTES, Journal
from extras.recovery.path import Refusal, State, Tolerance, locate, locate_flat, moves

KNOWN = {"PARK"}.__contains__
TOLERANCE = Tolerance(0.2, 0.04)


def state() -> State:
    return State([0.0] * 4, [0.0] * 4, [0.0] * 4, True, False, 25.0, 1.0, 1.0)


def test_the_newest_whole_record_is_read(tmp_path: Path) -> None:
    path = tmp_path / "recovery"
    journal = Journal(str(path))
    for number in range(3):
        journal.write({"offset": number})
    assert Journal(str(path)).read() == {"offset": 2}
    content = bytearray(path.read_bytes())
    content[SLOT_BYTES + 14] ^= 1  # the third record is in the second slot
    path.write_bytes(content)
    assert Journal(str(path)).read() == {"offset": 1}


def test_every_cut_of_the_last_write_leaves_the_record_before(tmp_path: Path) -> None:
    path = tmp_path / "recovery"
    journal = Journal(str(path))
    journal.write({"offset": 1})
    whole = path.read_bytes()
    journal.write({"offset": 2})
    after = path.read_bytes()
    slot = 0 if after[:SLOT_BYTES] != whole[:SLOT_BYTES] else SLOT_BYTES
    old = whole.ljust(len(after), b"\0")
    for cut in range(slot, slot + 20):
        path.write_bytes(after[:cut] + old[cut:])
        assert Journal(str(path)).read() == {"offset": 1}


def test_a_record_too_long_for_its_slot_is_refused_and_the_old_one_stays(tmp_path: Path) -> None:
    journal = Journal(str(tmp_path / "recovery"))
    journal.write({"offset": 1})
    with pytest.raises(OSError, match="more than"):
        journal.write({"text": "x" * SLOT_BYTES})
    assert Journal(str(tmp_path / "recovery")).read() == {"offset": 1}


def test_modes_origins_and_factors_count_on_the_way() -> None:
    text = b"G92 X10 E5\nM221 S50\nG1 X20 E2 F600\nG91\nG1 Y3 E1\nM82\nG90\nG1 Y5 E9\n"
    found = [segment.state.position for segment in moves(text, 0, state(), KNOWN)]
    assert found[1:] == [[10.0, 0.0, 0.0, 1.0], [10.0, 3.0, 0.0, 1.5], [10.0, 5.0, 0.0, 2.0]]


def test_a_line_that_may_move_otherwise_ends_the_search() -> None:
    text = b"G1 X5\nM201 X1\nPARK\nG1 X10\n"
    assert [segment.offset for segment in moves(text, 0, state(), KNOWN)] == [0, 6]
    with pytest.raises(Refusal, match="not on the path"):
        locate(moves(text, 0, state(), KNOWN), (8.0, 0.0, 0.0, 0.0), TOLERANCE)


def test_a_place_passed_twice_is_refused_if_something_was_extruded_meanwhile() -> None:
    loop = b"G1 X10 E1\nG1 X0 E1\nG1 E-2\nG1 X10\n"
    with pytest.raises(Refusal, match="more than once"):
        locate(moves(loop, 0, state(), KNOWN), (0.0, 0.0, 0.0, 0.0), TOLERANCE)


def test_where_the_filament_differs_a_place_passed_twice_is_found() -> None:
    place = locate(moves(b"G1 X10 E1\nG1 X0 E1\n", 0, state(), KNOWN), (4.0, 0.0, 0.0, 1.6), TOLERANCE)
    assert place.segment.offset == 19 and place.point == (4.0, 0.0, 0.0, 1.6)


def test_of_a_retraction_and_its_end_the_first_is_taken() -> None:
    text = b"G1 X10 E1\nG1 E-2\nG1 Z1\nG1 Z0\nG1 E2\nG1 X20 E1\n"
    place = locate(moves(text, 0, state(), KNOWN), (10.0, 0.0, 0.0, 0.3), TOLERANCE)
    assert text[: place.segment.offset].endswith(b"G1 E-2\n")
    assert place.point == pytest.approx((10.0, 0.0, 0.0, 0.3))


def flat(text: bytes, x: float, y: float, span_s: float = 9.0) -> Any:
    return locate_flat(moves(text, 0, state(), KNOWN), (x, y, 0.0), span_s, TOLERANCE)


def test_by_x_and_y_alone_one_place_is_found_with_its_filament() -> None:
    place = flat(b"G1 X10 E1\nG1 Y10 E1\n", 10.01, 4.0)
    assert place.segment.offset == 20 and place.point == pytest.approx((10.0, 4.0, 0.0, 1.4))


def test_what_comes_after_the_time_in_question_is_not_looked_at() -> None:
    there_and_back = b"G1 X50 E1\nG1 X0 E1\n"  # 2 s each
    assert flat(there_and_back, 4.0, 0.0, span_s=1.9).point[3] == pytest.approx(0.08)
    with pytest.raises(Refusal, match="more than once"):
        flat(there_and_back, 4.0, 0.0, span_s=2.1)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"G1 X10 E1\nG1 E-0.8\nG1 X20\n", "the extruder turned where the head stands"),
        (b"G1 X10 E1\nG1 Z0.4\nG1 X20\n", "the height changed where the head stands"),
        (b"G1 X9 E1\n", "does not stand on the path"),
    ],
)
def test_by_x_and_y_alone_what_they_do_not_show_is_refused(text: bytes, reason: str) -> None:
    with pytest.raises(Refusal, match=reason):
        flat(text, 10.0, 0.0)
