"""Carriages: the table of motors, limits of several on an axis, the text of a mix; drivers' registers and phases."""

from __future__ import annotations

import itertools
from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from extras.endstop_phase import circular_difference, spread
from extras.skew_correction import Skew, measured_skew
from extras.tmc import registers as tmc_registers
from extras.tmc import uart as tmc_uart
from kinematics.carriages import (
    COPY,
    INACTIVE,
    MIRROR,
    PRIMARY,
    Carriage,
    CarriageGroup,
    describe,
    solve_axes,
)
from kinematics.generic_cartesian import parse_mix


def carriage(name: str, low: float = 0.0, high: float = 200.0, endstop: float = 0.0) -> Carriage:
    rail: Any = SimpleNamespace(
        get_range=lambda: (low, high),
        get_homing_info=lambda: SimpleNamespace(position_endstop=endstop, positive_dir=endstop > low),
    )
    return Carriage(name, 0, rail, None, homed=True)


def group_of(*carriages: Carriage, safe_mm: float = 0.0) -> CarriageGroup:
    """On the x axis, every two of them this far apart."""
    return CarriageGroup(
        0, carriages, {frozenset(two): safe_mm for two in itertools.combinations(carriages, 2)}
    )


# ---- places from motors ----


@pytest.mark.parametrize("seed", range(20))
def test_axes_are_solved_as_by_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.uniform(-2, 2, (int(rng.integers(3, 7)), 3))
    values = rng.uniform(-300, 300, len(rows))
    wanted = np.linalg.lstsq(rows, values, rcond=None)[0]
    found = solve_axes([(tuple(row), float(v)) for row, v in zip(rows, values, strict=True)])
    assert found == pytest.approx(wanted, rel=1e-6, abs=1e-6)


def test_motors_that_do_not_determine_the_axes_are_noticed() -> None:
    assert solve_axes([((1.0, 1.0, 0.0), 1.0), ((2.0, 2.0, 0.0), 2.0), ((0.0, 0.0, 1.0), 3.0)]) is None
    assert solve_axes([((1.0, 0.0, 0.0), 1.0), ((0.0, 1.0, 0.0), 2.0)]) is None


# ---- limits ----


@given(
    st.sampled_from([INACTIVE, COPY, MIRROR]),
    st.floats(0, 200),
    st.floats(40, 240),
    st.floats(0, 60),
    st.floats(-50, 300),
)
def test_within_the_limits_both_carriages_are_safe(
    mode: str, first_at: float, second_at: float, safe_mm: float, target: float
) -> None:
    first, second = carriage("x"), carriage("u", 40, 240, 240)
    pair = group_of(first, second, safe_mm=safe_mm)
    second.mode, second.scale = mode, {INACTIVE: 0.0, COPY: 1.0, MIRROR: -1.0}[mode]
    second.offset = second_at - second.scale * first_at
    low, high = pair.limits()
    if low <= target <= high:
        x, u = first.place(target), second.place(target)
        assert 0 <= x <= 200
        if mode != INACTIVE:
            assert 40 - 1e-9 <= u <= 240 + 1e-9
        if safe_mm and (mode != COPY or second_at - first_at >= safe_mm):
            assert u - x >= safe_mm - 1e-9
    elif 0 <= target <= 200:  # outside for a reason
        u = second.place(target)
        assert (mode != INACTIVE and not 40 < u < 240) or u - target < safe_mm + 1e-9


def test_an_axis_that_is_not_homed_has_no_range() -> None:
    first, second = carriage("x"), carriage("u", 40, 240, 240)
    first.homed = False
    second.mode, second.scale = INACTIVE, 0.0
    low, high = group_of(first, second, safe_mm=40.0).limits()
    assert low > high


def test_the_outer_carriage_is_homed_first() -> None:
    def order(*carriages: Carriage) -> list[str]:
        return [c.name for c in group_of(*carriages).home_order()]

    assert order(carriage("x"), carriage("u", 40, 240, 240)) == ["x", "u"]
    assert order(carriage("x", endstop=0.0), carriage("u", -40, 160, -40)) == ["u", "x"]
    assert order(carriage("x", endstop=200.0), carriage("u", 40, 240, 240)) == ["u", "x"]
    assert order(carriage("x", endstop=200.0), carriage("u", 40, 190, 190)) == ["x", "u"]

    # three: those that home to the right from the right on, the one that homes to the left by itself
    right, middle = carriage("v", 80, 280, 280), carriage("u", 40, 240, 240)
    assert order(carriage("x"), middle, right) == ["x", "v", "u"]
    assert order(carriage("x"), right, middle) == ["x", "v", "u"]


MODES = st.sampled_from([INACTIVE, COPY, MIRROR])


@given(MODES, MODES, st.permutations(range(3)), st.floats(0, 60), st.floats(20, 100), st.floats(-50, 300))
def test_within_the_limits_three_carriages_keep_their_distances(
    mode1: str, mode2: str, roles: list[int], safe_mm: float, gap_mm: float, target: float
) -> None:
    places = [10.0, 10.0 + gap_mm, 10.0 + 2 * gap_mm]
    rails = [carriage("x"), carriage("u", 5, 245, 245), carriage("v", 10, 280, 280)]
    active, *others = (rails[i] for i in roles)
    for follower, mode in zip(others, (mode1, mode2), strict=True):
        follower.mode, follower.scale = mode, {INACTIVE: 0.0, COPY: 1.0, MIRROR: -1.0}[mode]
        follower.offset = places[rails.index(follower)] - follower.scale * places[rails.index(active)]
    low, high = group_of(active, *others, safe_mm=safe_mm).limits()
    if not low <= target <= high:
        return
    at = [c.place(target) for c in rails]
    for c, place in zip(rails, at, strict=True):
        rail_low, rail_high = c.rail.get_range()
        assert c.mode == INACTIVE or rail_low - 1e-9 <= place <= rail_high + 1e-9
    for (c, a), (d, b) in itertools.combinations(zip(rails, at, strict=True), 2):
        if safe_mm and c.scale != d.scale:
            assert b - a >= safe_mm - 1e-9, (c.name, d.name)


# ---- the text of a mix ----

NAMES = {name: carriage(name) for name in ("carriage_x", "carriage_y", "u", "x1")}


@given(
    st.dictionaries(
        st.sampled_from(sorted(NAMES)),
        st.integers(-4000, 4000).filter(bool).map(lambda n: n / 1000.0),
        min_size=1,
    )
)
def test_a_mix_survives_being_written(mix: dict[str, float]) -> None:
    wanted = {NAMES[name]: factor for name, factor in mix.items()}
    assert parse_mix(describe(wanted), NAMES) == pytest.approx(wanted)


@given(st.text(alphabet="carige_xyu1+-*. 0259", max_size=30))
def test_any_other_text_is_refused_with_a_reason(text: str) -> None:
    try:
        mix = parse_mix(text, NAMES)
    except ValueError as e:
        assert str(e)
    else:
        assert mix and all(mix.values())


@pytest.mark.parametrize(
    "text", ["", "carriage_x carriage_y", "carriage_x++carriage_y", "0*u", "u-u", "z", "2", "u+"]
)
def test_malformed_mixes(text: str) -> None:
    with pytest.raises(ValueError):
        parse_mix(text, NAMES)


# ---- skew ----


@given(*[st.floats(-0.2, 0.2)] * 3, *[st.floats(-300, 300)] * 3)
def test_the_corrected_command_reaches_the_wanted_point(a, b, c, x, y, z) -> None:
    skew = Skew(a, b, c)
    assert skew.reached(skew.commanded([x, y, z, 1.0, 2.0])) == pytest.approx([x, y, z, 1.0, 2.0], abs=1e-9)


@given(st.floats(50, 200), st.floats(50, 200), st.floats(-0.1, 0.1))
def test_skew_is_measured_from_the_part_it_makes(ab: float, ad: float, skew: float) -> None:
    """A printer with this skew makes of a rectangle the parallelogram whose diagonals are measured."""
    printer = Skew(xy=skew)
    corners = [np.array(printer.reached([x, y, 0.0])[:2]) for x, y in ((0, 0), (0, ab), (ad, ab), (ad, 0))]
    a, b, c, d = corners
    lengths = [float(np.linalg.norm(p - q)) for p, q in ((a, c), (b, d), (a, d))]
    assert measured_skew(*lengths) == pytest.approx(skew, abs=1e-6)


# ---- phases ----


@given(st.integers(0, 63), st.integers(0, 63))
def test_the_difference_of_phases_is_the_nearest(phase: int, reference: int) -> None:
    difference = circular_difference(phase, reference, 64)
    assert -32 <= difference <= 32 and (reference + difference - phase) % 64 == 0


def test_the_best_phase_lies_within_those_seen() -> None:
    assert spread(Counter({62: 1, 63: 3, 1: 1}), 64) == (63, 62, 1)
    assert spread(Counter({10: 5}), 64) == (10, 10, 10)
    assert spread(Counter({10: 1, 12: 1, 14: 1}), 64) == (12, 10, 14)


# ---- drivers ----


def test_datagrams_are_those_of_the_datasheet() -> None:
    """CRC vectors of real datagrams: a write of CHOPCONF, a read of IOIN."""
    assert tmc_uart.write_datagram(0, 0x6C, 0x10000053) == bytes.fromhex("0500ec10000053") + b"\x9c"
    assert tmc_uart.read_datagram(0, 0x06) == bytes.fromhex("0500066f")
    body = bytes.fromhex("05ff0621000009")
    answer = tmc_uart.to_bits(body + bytes([tmc_uart.crc8(body)]))
    assert tmc_uart.parse_answer(answer, 0x06) == 0x21000009
    assert tmc_uart.parse_answer(answer, 0x07) is None
    assert tmc_uart.parse_answer(b"", 0x06) is None


@given(st.binary(min_size=8, max_size=8), st.integers(0, 79))
def test_any_flipped_bit_of_an_answer_is_noticed(data: bytes, bit: int) -> None:
    body = b"\x05\xff\x06" + data[:4]
    packed = tmc_uart.to_bits(body + bytes([tmc_uart.crc8(body)]))
    damaged = bytearray(packed)
    damaged[bit // 8] ^= 1 << bit % 8
    assert tmc_uart.parse_answer(packed, 0x06) == int.from_bytes(data[:4], "big")
    assert tmc_uart.parse_answer(bytes(damaged), 0x06) is None


def test_microsteps_and_thresholds() -> None:
    assert [tmc_registers.microstep_bits(n) for n in (1, 16, 256)] == [8, 4, 0]
    for wrong in (0, 3, 512):
        with pytest.raises(ValueError):
            tmc_registers.microstep_bits(wrong)
    # 40 mm a turn, 200 full steps: a 1/256 step is 0.78125 um; at 100 mm/s one takes 7.8125 us = 93.75 clocks
    assert tmc_registers.speed_threshold(100.0, 0.0125, 16, 12e6) == 94
    assert tmc_registers.speed_threshold(0.0, 0.0125, 16, 12e6) == 0xFFFFF


def test_mode_names() -> None:
    assert {PRIMARY, COPY, MIRROR, INACTIVE} == {"PRIMARY", "COPY", "MIRROR", "INACTIVE"}
