"""src/signal_test.c: which samples a test takes, what it finds, and that a sound signal never trips."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from pure_harness import load_induction

ffi, lib = load_induction()
NONE, UNMOVED, CONDUCTS, JUMP = 0, 6, 7, 8
NO_KIND, MOVE, OFF = range(3)
LEN, OFF_LEN, SETTLE, LEARN, EDGE = 16, 48, 20, 4, 2
MOVED = EDGE + LEN
LIMITS = {"moved_low": 16 * 70, "moved_high": 16 * 100, "off_low": 250, "off_high": 262, "interval": 1200}
LIMITS |= {"tolerance": 26, "slack": 16, "phase": 2012, "jump": 16 * 15, "rise": 16, "fall": 1}


def fresh(**changes: int):
    t = ffi.new("struct signal_test *")
    lib.signal_test_init(t)
    limits = ffi.new("struct signal_test_limits *", LIMITS | changes)
    assert lib.signal_test_configure(t, limits[0]) == 1
    return t


def learned(moved: float = 85, **changes: int):
    """One that has learned how far a move goes."""
    t = fresh(**changes)
    t.learned_moves, t.learned = LEARN, round(LEARN * 32 * moved)
    return t


def feed(t, codes: list[int], index: int) -> int:
    samples = ffi.new("uint16_t[]", codes)
    found, run = NONE, ffi.new("uint16_t *")
    done = 0
    while done < len(codes) and found == NONE:
        lib.signal_test_run(t, (index + done) & 0xFFFFFFFF, len(codes) - done, run)
        found = lib.signal_test_feed(t, samples + done, (index + done) & 0xFFFFFFFF, run[0])
        done += run[0]
    return found


def one_test(t, at: int, code: Callable[[int, int], int], late: int = 0, chunk: int = 32) -> tuple[int, int]:
    """A whole test planned for `at`: (kind, trip). code(place in the test, kind) gives each sample."""
    kind = lib.signal_test_plan(t, at & 0xFFFFFFFF, 14230)
    begin = at + late
    end = begin + lib.signal_test_length(t)
    begun, index, found = False, at - LEN, NONE
    stop = end + (SETTLE if kind == OFF else EDGE) + LEN
    while index < stop and found == NONE:
        if not begun and index >= begin - chunk:
            lib.signal_test_begin(t, begin & 0xFFFFFFFF)
            begun = True
        if begun and index >= end:
            lib.signal_test_end(t, end & 0xFFFFFFFF, SETTLE)
        if index < end < index + chunk:
            upto = end
        else:
            upto = min(index + chunk, stop)
        places = range(index - begin, upto - begin)
        found = feed(t, [code(place, kind) for place in places], index & 0xFFFFFFFF)
        index = upto
    return kind, found


def sound(place: int, kind: int) -> int:
    """The samples at the edges may have either value."""
    length = MOVED if kind == MOVE else OFF_LEN
    if not 0 <= place < length:
        return 450 if kind == OFF or place < 0 or place >= MOVED + EDGE else 0
    if kind == OFF:
        return 256
    return 535 if place >= EDGE else 4095


def test_kinds_alternate_and_a_sound_signal_passes_them() -> None:
    t = learned()
    found = [one_test(t, 10_000 * n, sound) for n in range(1, 7)]
    assert found == [(MOVE, NONE), (OFF, NONE)] * 3


@pytest.mark.parametrize("late", [0, 1, 3])
@pytest.mark.parametrize("at", [5000, 2**32 - 10, 2**32])
def test_a_test_that_begins_late_or_where_indices_wrap_finds_the_same(late: int, at: int) -> None:
    t = learned()
    assert one_test(t, at, sound, late) == (MOVE, NONE)
    assert one_test(t, at + 5000, sound, late) == (OFF, NONE)
    assert (t.bad_moves, t.bad_offs) == (0, 0)


def test_a_frozen_signal_trips_at_the_second_move_in_a_row_and_noise_does_not_hide_it() -> None:
    noise = random.Random(1)
    t = learned()

    def frozen(place: int, kind: int) -> int:
        return 450 + round(noise.gauss(0, 1))

    assert one_test(t, 1000, frozen) == (MOVE, NONE)
    assert lib.signal_test_is_due(t, 1200), "the next comes at once"
    assert one_test(t, 1200, frozen) == (MOVE, UNMOVED)


@pytest.mark.parametrize(
    ("moved", "trip"), [(69.9, UNMOVED), (70, NONE), (100, NONE), (100.1, UNMOVED), (-85, UNMOVED)]
)
def test_the_limits_of_a_move_hold_to_the_last_count(moved: float, trip: int) -> None:
    """A count of 16 samples: 69.9 is 70 less one and 100.1 100 more one, of 16."""
    t = fresh()
    whole, extra = int(moved // 1), 0 if moved == int(moved) else (15 if moved < 70 else 1)

    def code(place: int, kind: int) -> int:
        return 450 + (whole + (1 if place - EDGE < extra else 0) if EDGE <= place < MOVED else 0)

    assert [one_test(t, n, code)[1] for n in (1000, 1200)] == [NONE, trip]


def moves_by(moved: float) -> Callable[[int, int], int]:
    """A signal that moves by that, in steps of 1/16 of a sample's LSB."""
    whole = int(moved)
    more = round(16 * (moved - whole))
    return lambda place, kind: 450 + (whole + (place - EDGE < more) if EDGE <= place < MOVED else 0)


def test_the_first_moves_come_one_after_the_other_and_are_learned() -> None:
    t = fresh()
    assert lib.signal_test_moved(t) == 0
    at = 1000
    for n in range(LEARN):
        assert lib.signal_test_is_due(t, at)
        assert one_test(t, at, moves_by(80 + n)) == (MOVE, NONE)
        at += MOVED + EDGE + LEN
    assert lib.signal_test_moved(t) == 16 * 81.5
    assert not lib.signal_test_is_due(t, at) and lib.signal_test_is_due(t, at + 1200)
    assert one_test(t, at + 1200, sound)[0] == OFF


@pytest.mark.parametrize(("moved", "bad"), [(75.5, 0), (75 + 5 / 16, 1), (94.5, 0), (94 + 11 / 16, 1)])
def test_what_is_learned_bounds_later_moves(moved: float, bad: int) -> None:
    """26/256 of 85 and one LSB: 9.63. Not learned further: the thousandth test has the bounds of the fifth."""
    t = learned(85, moved_low=0, moved_high=3000)
    t.before_kind = OFF
    assert one_test(t, 1000, moves_by(moved)) == (MOVE, NONE)
    assert t.bad_moves == bad and lib.signal_test_moved(t) == 16 * 85


def test_a_bad_move_is_not_learned() -> None:
    t = fresh()
    one_test(t, 1000, lambda place, kind: 450)
    assert (t.bad_moves, t.learned_moves, t.learned) == (1, 0, 0)


def test_the_bounds_of_what_is_learned_do_not_overflow() -> None:
    t = learned(4095, moved_low=0, moved_high=65535, tolerance=255, slack=65535)
    t.before_kind = OFF
    one_test(t, 1000, lambda place, kind: 0)
    assert t.bad_moves == 0


def test_a_slope_does_not_count_as_a_move() -> None:
    for at in (1000, 3000, 5000):
        t = fresh(moved_low=16 * 85 - 9, moved_high=16 * 85 + 9)
        one_test(t, at, lambda place, kind: 400 + place + (85 if EDGE <= place < MOVED else 0))
        assert t.bad_moves == 0


def test_a_bridge_that_conducts_trips_at_the_second_look_and_a_move_between_is_good() -> None:
    t = learned()

    def conducts(place: int, kind: int) -> int:
        return sound(place, MOVE) if kind == MOVE else 450

    found = [one_test(t, 1000 + 300 * n, conducts) for n in range(4)]
    assert found == [(MOVE, NONE), (OFF, NONE), (MOVE, NONE), (OFF, CONDUCTS)]


@pytest.mark.parametrize(("code", "bad"), [(249, 1), (250, 0), (262, 0), (263, 1)])
def test_the_limits_of_no_current_hold(code: int, bad: int) -> None:
    t = fresh(moved_high=0, moved_low=0)
    assert one_test(t, 1000, lambda place, kind: code if place >= OFF_LEN - LEN else 900) == (OFF, NONE)
    assert t.bad_offs == bad


@pytest.mark.parametrize("kinds", [{"off_low": 0, "off_high": 0}, {"moved_low": 0, "moved_high": 0}])
def test_samples_in_small_pieces_and_long_before_a_test_give_the_same_verdict(kinds: dict[str, int]) -> None:
    t = fresh(**kinds)
    kind = lib.signal_test_plan(t, 1000, 14230)
    length = lib.signal_test_length(t)
    good_from = 1000 + length + (SETTLE if kind == OFF else EDGE)
    for index in range(900, good_from + LEN - 1):
        if index == 1000:
            lib.signal_test_begin(t, 1000)
        if index == 1000 + length:
            lib.signal_test_end(t, 1000 + length, SETTLE)
        if t.kind != NO_KIND:
            assert feed(t, [sound(index - 1000, kind)], index) == NONE
    assert t.kind == (MOVE if kind == MOVE else NO_KIND)
    assert feed(t, [sound(length, kind)], good_from + LEN - 1) == NONE
    assert (t.kind, t.bad_moves, t.bad_offs) == (NO_KIND, 0, 0)


@pytest.mark.parametrize(("phase", "kind"), [(22499, OFF), (22500, MOVE)])
def test_a_bridge_that_is_driven_hard_is_not_switched_off(phase: int, kind: int) -> None:
    t = learned()
    t.before_kind = MOVE
    assert lib.signal_test_plan(t, 1000, phase) == kind
    alone = learned(moved_low=0, moved_high=0)
    assert lib.signal_test_plan(alone, 1000, phase) == (OFF if kind == OFF else NO_KIND)
    assert alone.kind == (OFF if kind == OFF else NO_KIND)


def test_one_bad_test_between_good_ones_does_not_trip() -> None:
    t = learned(off_low=0, off_high=0)
    for n in range(6):
        _, found = one_test(t, 2000 * (n + 1), sound if n % 2 else lambda place, kind: 450)
        assert found == NONE
        assert t.bad_moves == 1 - n % 2


def test_the_next_test_waits_for_its_interval() -> None:
    t = learned()
    assert lib.signal_test_is_due(t, 0)
    one_test(t, 1000, sound)
    end = 1000 + MOVED + EDGE + LEN
    assert not lib.signal_test_is_due(t, end + 1199)
    assert lib.signal_test_is_due(t, end + 1200)


def test_nothing_is_due_while_a_test_is_planned_or_none_is_configured() -> None:
    t = learned()
    lib.signal_test_plan(t, 500, 14230)
    assert not lib.signal_test_is_due(t, 600)
    bare = ffi.new("struct signal_test *")
    lib.signal_test_init(bare)
    assert not lib.signal_test_is_due(bare, 0)


def test_only_samples_between_beginning_and_end_are_skipped() -> None:
    t = learned()
    run = ffi.new("uint16_t *")

    def asked(index: int, count: int) -> tuple[int, int]:
        skip = lib.signal_test_run(t, index, count, run)
        return skip, run[0]

    lib.signal_test_plan(t, 1000, 14230)
    assert asked(990, 32) == (0, 32)
    lib.signal_test_begin(t, 1001)
    assert asked(990, 32) == (0, 11)
    assert asked(990, 5) == (0, 5)
    assert asked(1001, 32) == (1, 32)
    lib.signal_test_end(t, 1017 - EDGE, SETTLE)
    assert asked(1001, 32) == (1, 16)
    assert asked(1001, 8) == (1, 8)
    assert asked(1017, 32) == (0, 32)


def test_a_cancelled_look_without_current_skips_until_the_coil_has_settled() -> None:
    t, run = learned(moved_low=0, moved_high=0), ffi.new("uint16_t *")
    lib.signal_test_plan(t, 1000, 14230)
    lib.signal_test_begin(t, 1000)
    assert lib.signal_test_cancel(t, 1010, SETTLE) == OFF
    assert lib.signal_test_run(t, 1000, 64, run) == 1 and run[0] == 10 + SETTLE


def test_a_cancelled_test_has_no_verdict_and_says_what_to_undo() -> None:
    t = learned()
    assert lib.signal_test_cancel(t, 900, SETTLE) == NO_KIND
    lib.signal_test_plan(t, 1000, 14230)
    assert lib.signal_test_cancel(t, 990, SETTLE) == NO_KIND
    lib.signal_test_plan(t, 1000, 14230)
    lib.signal_test_begin(t, 1000)
    assert lib.signal_test_cancel(t, 1006, SETTLE) == MOVE
    assert feed(t, [450] * 18, 990) == NONE
    run = ffi.new("uint16_t *")
    assert lib.signal_test_run(t, 1000, 32, run) == 1 and run[0] == 8
    assert lib.signal_test_run(t, 1008, 32, run) == 0 and not t.begun, "all of it has been passed"
    assert not lib.signal_test_is_due(t, 1007) and lib.signal_test_is_due(t, 1008)
    lib.signal_test_plan(t, 2000, 14230)
    lib.signal_test_begin(t, 2000)
    lib.signal_test_end(t, 2016, SETTLE)
    assert lib.signal_test_cancel(t, 2020, SETTLE) == NO_KIND


@pytest.mark.parametrize(
    "changes",
    [
        {"moved_low": 2000},
        {"off_low": 300},
        {"interval": 191},
        {"interval": 191, "moved_low": 0, "moved_high": 0},
    ],
    ids=["move", "off", "no room", "no room for off alone"],
)
def test_limits_that_make_no_sense_are_refused(changes: dict[str, int]) -> None:
    t = learned()
    assert not lib.signal_test_configure(t, ffi.new("struct signal_test_limits *", LIMITS | changes)[0])
    assert t.limits.interval == 1200


def test_without_tests_the_interval_may_be_anything() -> None:
    fresh(moved_low=0, moved_high=0, off_low=0, off_high=0, interval=0)
    assert lib.signal_test_is_due(fresh(moved_low=0, moved_high=0, interval=192), 0)
    fresh(off_low=0, off_high=0, interval=192)


def block(t, mean: float, first: int, phase: int = 5000, count: int = 192) -> int:
    seen = {"sum": round(mean * count), "count": count, "phase": phase, "min": 1, "max": 900}
    return lib.signal_test_block(t, ffi.new("struct guard_input *", seen), first & 0xFFFFFFFF)


@pytest.mark.parametrize("start", [0, 2**32 - 100])
@pytest.mark.parametrize("step", [-36, 40])
def test_a_jump_trips_at_its_third_block(start: int, step: int) -> None:
    t = learned()
    assert block(t, 450, start) == NONE
    assert [block(t, 450 + step, start + 192 * n) for n in (1, 2, 3)] == [NONE, NONE, JUMP]


def test_two_blocks_that_stand_out_are_forgotten() -> None:
    t = learned()
    for n, mean in enumerate([450, 500, 500, 450, 500, 500, 450]):
        assert block(t, mean, 192 * n) == NONE


@pytest.mark.parametrize(
    ("mean", "bad", "phase"),
    [
        (450 + 18 + 15 / 16, 0, 2184),
        (450 + 19, 1, 2184),
        (450 - 15 - 18 / 16, 0, 2184),
        (450 - 15 - 19 / 16, 1, 2184),
        (450 + 80 + 5 / 16 + 3, 0, 45000),
        (450 + 80 + 6 / 16 + 3, 1, 45000),
        (450 + 30 + 3, 0, 32768),
        (450 + 30 + 1 / 16 + 3, 1, 32768),
    ],
)
def test_a_nozzle_may_rise_and_fall_between_two_blocks(mean: float, bad: int, phase: int) -> None:
    """192 samples apart: 15 LSB times 1 + phase / 32768 (2184: 15 sixteenths more), and 3 LSB up or 3/16 LSB down.

    Above a phase of 32768 the limit rises faster.
    """
    t = learned()
    block(t, 450, 0, phase)
    assert block(t, mean, 192, phase) == NONE
    assert t.bad_jumps == bad


@pytest.mark.parametrize(("phase", "judged"), [(5156, 1), (5162, 0), (4849, 1), (4840, 0), (5000, 1)])
def test_blocks_of_different_drives_are_not_compared(phase: int, judged: int) -> None:
    t = learned()
    block(t, 450, 0, 5000)
    block(t, 500, 192, phase)
    assert t.bad_jumps == judged


def test_blocks_of_different_lengths_are_compared_by_their_means() -> None:
    t = fresh()
    block(t, 450, 0)
    block(t, 464, 192, count=20)
    assert t.bad_jumps == 0
    block(t, 500, 212, count=192)
    assert t.bad_jumps == 1


def test_the_limit_of_a_jump_does_not_overflow() -> None:
    t = fresh(jump=65535, rise=65535, fall=65535)
    block(t, 0, 0, 45000, 16384)
    assert block(t, 4095, 16384, 45000, 16384) == NONE and t.bad_jumps == 0
    assert block(t, 0, 32768, 45000, 16384) == NONE and t.bad_jumps == 0


def test_below_the_smallest_phase_and_after_a_long_time_nothing_is_compared() -> None:
    t = learned()
    block(t, 450, 0, 2011)
    block(t, 900, 192, 2011)
    assert t.bad_jumps == 0
    block(t, 450, 384)
    block(t, 900, 384 + 2**15)
    assert t.bad_jumps == 0
    block(t, 450, 384 + 2**15 + 192)
    assert t.bad_jumps == 1


def test_without_a_limit_jumps_are_not_judged() -> None:
    t = fresh(jump=0)
    block(t, 450, 0)
    assert block(t, 900, 192) == NONE and t.bad_jumps == 0


@pytest.mark.parametrize("mean", [249, 263])
def test_a_bridge_that_conducts_while_nothing_drives_it_trips_at_the_fourth_block(mean: float) -> None:
    t = fresh()
    found = [block(t, mean, 192 * n, phase=0) for n in range(4)]
    assert found == [NONE, NONE, NONE, CONDUCTS]


@pytest.mark.parametrize("mean", [250, 262])
def test_blocks_without_drive_may_show_no_current_for_ever(mean: float) -> None:
    t = fresh()
    assert {block(t, mean, 192 * n, phase=0) for n in range(20)} == {NONE}


@pytest.mark.parametrize(("mean", "phase"), [(256, 0), (400, 2012)])
def test_a_block_without_current_and_one_with_drive_end_the_count(mean: float, phase: int) -> None:
    t = fresh()
    for n in range(0, 40, 4):
        assert {block(t, 400, 192 * (n + i), phase=0) for i in range(3)} == {NONE}
        assert block(t, mean, 192 * (n + 3), phase) == NONE


def test_without_limits_of_no_current_blocks_without_drive_are_not_judged() -> None:
    t = fresh(off_low=0, off_high=0)
    assert {block(t, 400, 192 * n, phase=0) for n in range(8)} == {NONE}
