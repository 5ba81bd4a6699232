"""src/attention.c: what strays is told, what does not is not, and no sum overflows."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pure_harness import load_induction

ffi, lib = load_induction()

LIMIT_MAX = 1 << 24
SUM_MAX = 4095 * 4**7  # of the longest block


@dataclass
class Wanted:
    """The description in attention.h, in real numbers."""

    expected: dict[int, int]
    limit: int
    mean: float = 0.0

    def strays(self, phase: int, total: int) -> bool:
        off = total - self.expected[phase]
        self.mean += (off - self.mean) / 8.0
        return abs(off) > 8 * self.limit or abs(self.mean) > self.limit


@given(
    expected=st.integers(0, SUM_MAX),
    limit=st.integers(1, LIMIT_MAX),
    levels=st.lists(st.tuples(st.floats(-1.6, 1.6), st.integers(1, 30)), min_size=1, max_size=6),
)
def test_it_strays_when_the_mean_does(expected: int, limit: int, levels: list[tuple[float, int]]) -> None:
    a = ffi.new("struct attention *")
    wanted = Wanted({9000: expected}, limit)
    lib.attention_expect(a, 9000, expected, limit)
    for share in (share for share, blocks in levels for _ in range(blocks)):
        total = min(SUM_MAX, max(0, expected + round(share * limit)))
        told = lib.attention_block(a, 9000, total)
        strays = wanted.strays(9000, total)
        # an eighth is rounded down at each block: the integers' mean is up to one of a sum's counts off
        if abs(abs(wanted.mean) - limit) > 1.0:
            assert told == strays
        if told or strays:
            return


@pytest.mark.parametrize("total", [0, SUM_MAX])
@pytest.mark.parametrize("expected", [0, SUM_MAX, 2**32 - 1])
def test_the_farthest_there_is_strays_at_once_or_is_expected(total: int, expected: int) -> None:
    a = ffi.new("struct attention *")
    lib.attention_expect(a, 1, expected, 2**32 - 1)  # cut to LIMIT_MAX
    near = min((total - expected) % 2**32, (expected - total) % 2**32) <= 8 * LIMIT_MAX
    assert lib.attention_block(a, 1, total) == (not near)


def test_nothing_expected_nothing_strays() -> None:
    a = ffi.new("struct attention *")
    assert not lib.attention_block(a, 0, 12345)
    lib.attention_expect(a, 9000, 100_000, 10)
    assert not lib.attention_block(a, 9001, 0)
    assert lib.attention_block(a, 9000, 0)
    assert not lib.attention_block(a, 9000, 0)  # told once


def test_what_is_expected_of_a_phase_to_come_waits_for_its_first_block() -> None:
    a = ffi.new("struct attention *")
    lib.attention_expect(a, 9000, 100_000, 100)
    for _ in range(30):  # the mean comes to 90 of 100
        assert not lib.attention_block(a, 9000, 100_090)
    lib.attention_expect(a, 9500, 200_000, 100)
    assert not lib.attention_block(a, 9000, 100_090)  # still judged by what was expected before
    assert not lib.attention_block(a, 9700, 0)  # a phase nobody expects anything of
    for _ in range(3):  # the mean begins anew: 38, 70, 99
        assert not lib.attention_block(a, 9500, 200_300)
    assert not lib.attention_block(a, 9000, 0)  # the phase before is not expected any more
    assert lib.attention_block(a, 9500, 200_300) == 1


def test_the_phase_in_force_is_judged_until_the_step_comes() -> None:
    a = ffi.new("struct attention *")
    lib.attention_expect(a, 9000, 100_000, 100)
    lib.attention_expect(a, 9500, 200_000, 100)
    assert lib.attention_block(a, 9000, 100_801) == 1


def test_after_straying_what_is_expected_holds_at_once() -> None:
    a = ffi.new("struct attention *")
    lib.attention_expect(a, 9000, 100_000, 100)
    assert lib.attention_block(a, 9000, 0)
    lib.attention_expect(a, 9500, 200_000, 100)
    lib.attention_expect(a, 9600, 300_000, 100)  # 9500 is in force since the one before
    assert lib.attention_block(a, 9500, 0) == 1


@pytest.mark.parametrize("sign", [1, -1])
def test_one_block_strays_at_once_beyond_eight_limits_and_not_at_them(sign: int) -> None:
    a = ffi.new("struct attention *")
    lib.attention_expect(a, 9000, 100_000, 100)
    assert not lib.attention_block(a, 9000, 100_000 + sign * 800)
    lib.attention_expect(a, 9500, 200_000, 100)
    assert not lib.attention_block(a, 9500, 200_000 + sign * 800)  # so too at the first block of a step
    lib.attention_expect(a, 9500, 300_000, 100)
    assert lib.attention_block(a, 9500, 300_000 + sign * 801) == 1


@pytest.mark.parametrize("sign", [1, -1])
def test_one_block_strays_at_once_also_against_a_mean_on_the_other_side(sign: int) -> None:
    a = ffi.new("struct attention *")
    lib.attention_expect(a, 9000, 100_000, 100)
    for _ in range(30):
        assert not lib.attention_block(a, 9000, 100_000 - sign * 90)
    assert lib.attention_block(a, 9000, 100_000 + sign * 801) == 1


@pytest.mark.parametrize("asked", [LIMIT_MAX - 1, LIMIT_MAX, LIMIT_MAX + 1])
def test_a_limit_is_held_to_the_greatest(asked: int) -> None:
    a, limit = ffi.new("struct attention *"), min(asked, LIMIT_MAX)
    lib.attention_expect(a, 9000, 0, asked)
    assert not lib.attention_block(a, 9000, 8 * limit)
    lib.attention_expect(a, 9000, 0, asked)
    assert lib.attention_block(a, 9000, 8 * limit + 1) == 1


def test_a_new_expectation_at_the_same_phase_begins_with_a_mean_of_nothing() -> None:
    a = ffi.new("struct attention *")
    lib.attention_expect(a, 9000, 100_000, 100)
    for _ in range(30):  # the mean comes to 90 of 100
        assert not lib.attention_block(a, 9000, 100_090)
    lib.attention_expect(a, 9000, 100_000, 100)
    for _ in range(3):  # 300 off: from nothing 38, 70, 99; from 90 at once 116
        assert not lib.attention_block(a, 9000, 100_300)
    assert lib.attention_block(a, 9000, 100_300)
