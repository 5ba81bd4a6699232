"""src/guard.c: limits at their boundaries, latching, off until enabled, dead host."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pure_harness import load_induction

ffi, lib = load_induction()
NONE, LOW, HIGH, CLIPPED, STUCK, TIMEOUT = range(6)


def guard(*rows: tuple[int, int, int, int], max_duration: int = 7_200_000, silence: int = 216_000_000):
    g = ffi.new("struct guard *")
    lib.guard_init(g, 4095, max_duration, silence)
    for row in rows:
        assert lib.guard_add_row(g, row) == 1
    return g


def judge(g, mean: float, phase: int = 5000, count: int = 1024, low=None, high=None) -> int:
    """One block of the given mean; min and max two codes around it unless given."""
    total = round(mean * count)
    block = {"sum": total, "count": count, "phase": phase}
    block["min"] = int(mean) - 2 if low is None else low
    block["max"] = int(mean) + 3 if high is None else high
    return lib.guard_block(g, ffi.new("struct guard_input *", block))


def test_without_a_table_nothing_is_judged():
    g = guard()
    for mean, low, high in ((0, 0, 0), (4095, 4095, 4095), (300, 300, 300)):
        for _ in range(20):
            assert judge(g, mean, low=low, high=high) == NONE
    assert g.trip == NONE


@pytest.mark.parametrize("count", [64, 1024])
@pytest.mark.parametrize(
    ("extra", "mean", "expected"), [(0, 200, NONE), (-1, 200, LOW), (0, 900, NONE), (1, 900, HIGH)]
)
def test_limits_hold_to_the_last_count_of_the_sum(count, extra, mean, expected):
    g = guard((2000, 200, 900, 1))
    block = {"sum": mean * count + extra, "count": count, "phase": 2000, "min": mean - 2, "max": mean + 2}
    assert lib.guard_block(g, ffi.new("struct guard_input *", block)) == expected
    assert g.trip == expected


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0, 310, CLIPPED), (1, 310, NONE), (290, 4095, CLIPPED), (290, 4094, NONE), (300, 300, NONE)],
)
def test_dead_signal_trips_inside_the_limits(low, high, expected):
    g = guard((0, 0, 65535, 1))
    assert judge(g, 300, low=low, high=high) == expected


@pytest.mark.parametrize(("near", "far"), [(13191, 13192), (1, 0)])
def test_one_code_is_a_dead_signal_once_the_phase_has_moved_far(near, far):
    first = 5000 if far > near else 8192
    g = guard((0, 0, 65535, 3))
    for phase in (first, first, near, first):
        assert judge(g, 300, phase, low=300, high=300) == NONE
    assert judge(g, 300, far, low=300, high=300) == NONE
    assert judge(g, 300, far, low=300, high=300) == NONE
    assert judge(g, 300, first, low=300, high=300) == STUCK, "it stays so until another code is seen"


def test_a_quiet_signal_that_moves_with_the_phase_is_no_dead_signal():
    g = guard((0, 0, 65535, 1))
    for phase, code in [(2012, 500), (2012, 500), (45000, 330), (45000, 330), (2012, 500), (20000, 501)]:
        assert judge(g, code, phase, low=code, high=code) == NONE


def test_rows_hold_from_their_phase_to_the_next():
    rows = ((2000, 100, 200, 1), (10000, 300, 400, 1), (20000, 0, 65535, 0))
    expect = {1999: NONE, 2000: HIGH, 9999: HIGH, 10000: NONE, 19999: NONE, 20000: NONE, 45000: NONE}
    for phase, verdict in expect.items():
        assert judge(guard(*rows), 350, phase=phase) == verdict, phase
    assert judge(guard(*rows), 5, phase=45000, low=5, high=5) == NONE, "a row of 0 blocks switches off"


def test_only_bad_blocks_in_a_row_trip():
    g = guard((0, 200, 900, 3))
    for mean, expected in [(100, NONE), (100, NONE), (300, NONE), (100, NONE), (950, NONE), (100, LOW)]:
        assert judge(g, mean) == expected


def test_an_unjudged_block_starts_the_count_again():
    g = guard((2000, 200, 900, 2))
    assert judge(g, 100) == NONE
    assert judge(g, 100, phase=0) == NONE
    assert judge(g, 100) == NONE
    assert judge(g, 100) == LOW


def test_first_trip_is_kept_with_what_caused_it():
    g = guard((0, 200, 900, 1))
    assert judge(g, 1000, count=500) == HIGH
    assert judge(g, 100) == NONE
    assert (g.trip, g.trip_value, g.trip_count) == (HIGH, 500_000, 500)
    lib.guard_fed(g, 0, 10)
    assert lib.guard_lapse(g, 2**31 - 1) and lib.guard_check_silence(g, 2**31 - 1) == NONE
    assert g.trip == HIGH


@pytest.mark.parametrize(
    "row", [(2000, 5, 10, 1), (1999, 5, 10, 1), (3000, 10, 9, 1)], ids=["same", "descending", "inverted"]
)
def test_a_row_out_of_order_is_refused(row):
    g = guard((2000, 0, 65535, 1))
    assert not lib.guard_add_row(g, row)
    assert g.row_count == 1


def test_limits_may_leave_one_mean():
    g = guard((0, 300, 300, 1))
    assert judge(g, 300) == NONE
    assert judge(g, 301) == HIGH


def test_the_longest_count_of_bad_blocks_trips_at_its_end_and_once():
    g = guard((0, 200, 900, 255))
    assert [judge(g, 100) for _ in range(600)] == [NONE] * 254 + [LOW] + [NONE] * 345


def test_a_full_table_refuses_more():
    g = guard(*((phase, 0, 1, 1) for phase in range(12)))
    assert not lib.guard_add_row(g, (100, 0, 1, 1))


@pytest.mark.parametrize("fed", [0, 123456, 2**32 - 1000])
def test_silence_has_the_power_lapse_at_max_duration_and_trips_at_its_end(fed):
    g = guard(max_duration=7200, silence=90000)
    lib.guard_fed(g, fed, 1)  # the smallest phase is power, too
    assert lib.guard_deadline(g) == (fed + 7200) & 0xFFFFFFFF
    assert not lib.guard_lapse(g, (fed + 7199) & 0xFFFFFFFF)
    assert lib.guard_check_silence(g, (fed + 90000) & 0xFFFFFFFF) == NONE, "power comes first"
    assert lib.guard_lapse(g, (fed + 7200) & 0xFFFFFFFF)
    assert not lib.guard_lapse(g, (fed + 7201) & 0xFFFFFFFF), "once"
    assert lib.guard_is_waiting(g)
    assert (g.powered, g.trip, lib.guard_deadline(g)) == (0, NONE, (fed + 90000) & 0xFFFFFFFF)
    assert lib.guard_check_silence(g, (fed + 89999) & 0xFFFFFFFF) == NONE
    assert lib.guard_check_silence(g, (fed + 90000) & 0xFFFFFFFF) == TIMEOUT
    assert (g.trip, g.trip_value, g.trip_count) == (TIMEOUT, (fed + 90000) & 0xFFFFFFFF, 0)


@pytest.mark.parametrize("phase", [0, 2012])
def test_the_next_command_ends_a_lapse(phase):
    g = guard(max_duration=7200, silence=90000)
    lib.guard_fed(g, 0, 2012)
    assert lib.guard_lapse(g, 7200)
    lib.guard_fed(g, 89999, phase)
    assert lib.guard_check_silence(g, 90000) == NONE
    assert lib.guard_is_waiting(g) == (phase > 0)


def test_a_silence_shorter_than_max_duration_trips_as_soon_as_the_power_lapses():
    g = guard(max_duration=7200, silence=5000)
    lib.guard_fed(g, 0, 2012)
    assert lib.guard_lapse(g, 7200) and lib.guard_check_silence(g, 7200) == TIMEOUT


def test_silence_without_power_is_no_fault():
    g = guard(max_duration=7200, silence=90000)
    assert not lib.guard_is_waiting(g)
    assert not lib.guard_lapse(g, 10**9) and lib.guard_check_silence(g, 10**9) == NONE
    lib.guard_fed(g, 0, 2012)
    assert lib.guard_is_waiting(g)
    lib.guard_fed(g, 100, 0)
    assert not lib.guard_lapse(g, 10**9) and lib.guard_check_silence(g, 10**9) == NONE


def test_a_bridge_that_is_off_for_good_waits_for_nobody():
    g = guard(max_duration=7200, silence=90000)
    lib.guard_fed(g, 0, 2012)
    assert lib.guard_lapse(g, 7200)
    lib.guard_off(g)
    assert not lib.guard_is_waiting(g) and lib.guard_check_silence(g, 10**9) == NONE
    lib.guard_fed(g, 0, 2012)
    lib.guard_off(g)
    assert not lib.guard_is_waiting(g) and not lib.guard_lapse(g, 10**9)


@pytest.mark.parametrize(
    ("phase", "share", "mean", "verdict"),
    [
        (20000, 0x8000, 500, NONE),  # half the way from 200 to 800
        (20000, 0x8000, 500.1, HIGH),
        (19999, 0x8000, 800, NONE),
        (20000, 65535, 800, NONE),
        (20000, 0, 200.1, HIGH),
        (20000, 0, 199, LOW),
    ],
)
def test_the_ceiling_lowers_the_high_limit_from_its_phase_on(phase, share, mean, verdict):
    g = guard((2000, 200, 800, 1))
    lib.guard_set_ceiling(g, 20000, share)
    assert judge(g, mean, phase=phase) == verdict


def test_a_trip_found_elsewhere_is_latched_like_its_own():
    g = guard((0, 200, 900, 1))
    assert lib.guard_latch(g, 6, 77, 16) == 6
    assert lib.guard_latch(g, 7, 78, 17) == NONE
    assert judge(g, 1000) == NONE
    assert (g.trip, g.trip_value, g.trip_count) == (6, 77, 16)


@settings(max_examples=200, deadline=None)
@given(
    rows=st.lists(
        st.tuples(st.integers(0, 45000), st.integers(0, 4095), st.integers(0, 4095), st.integers(0, 3)),
        max_size=12,
        unique_by=lambda row: row[0],
    ),
    blocks=st.lists(
        st.tuples(st.integers(0, 45000), st.integers(1, 16384), st.integers(0, 4095), st.integers(0, 9)),
        max_size=20,
    ),
)
def test_verdicts_equal_a_plain_reading_of_the_rules(rows, blocks):
    rows = sorted((phase, min(a, b), max(a, b), trip) for phase, a, b, trip in rows)
    g, bad, tripped = guard(*rows), 0, NONE
    flat = (None, 0, False)  # code, phase of its first block, stuck
    for phase, count, low, spread in blocks:
        high = min(low + spread, 4095)
        mean = (low + high) / 2
        total = round(mean * count)
        row = next((row for row in reversed(rows) if row[0] <= phase), None)
        verdict = NONE
        if row and row[3]:
            code, first, stuck = flat
            stays = low == high == code
            flat = (code, first, stuck or abs(phase - first) >= 8192) if stays else (low, phase, False)
            flat = flat if low == high else (None, 0, False)
            if total / count < row[1]:
                verdict = LOW
            elif total / count > row[2]:
                verdict = HIGH
            elif low == 0 or high == 4095:
                verdict = CLIPPED
            elif flat[2]:
                verdict = STUCK
        bad = bad + 1 if verdict else 0
        expected = verdict if verdict and bad >= row[3] and not tripped else NONE
        tripped = tripped or expected
        block = {"sum": total, "count": count, "phase": phase, "min": low, "max": high}
        assert lib.guard_block(g, ffi.new("struct guard_input *", block)) == expected
        assert g.trip == tripped
