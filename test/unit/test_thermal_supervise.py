"""Faults are named, latched, and only called when they are there."""

from __future__ import annotations

import math

import pytest

from thermal import supervise
from thermal.records import TempEstimate

PARAMETERS = supervise.SuperviseParameters(0.0, 300.0, limit_blocks=3)


def good(temp_c: float, time_s: float = 0.0) -> TempEstimate:
    return TempEstimate(time_s, temp_c, 1.0, 0.05, 1.25, 8000, True, "")


def bad(reason: str) -> TempEstimate:
    nan = math.nan
    return TempEstimate(0.0, nan, nan, nan, nan, 8000, False, reason)


def started() -> supervise.SuperviseState:
    state = supervise.SuperviseState()
    supervise.start(state, 0.0)
    return state


def live(
    state: supervise.SuperviseState, seconds: float, temp_of_time: object, target: float, power: float
) -> str:
    """Feed a healthy stream of blocks with the given temperatures."""
    for n in range(round(seconds / 0.017)):
        t = n * 0.017
        temp = temp_of_time(t)  # type: ignore[operator]
        supervise.observe(PARAMETERS, state, t, good(temp, t))
        fault = supervise.watch(PARAMETERS, state, t, temp, target, power)
        if fault:
            return fault
    return ""


def test_a_healthy_climb_and_hold_gives_no_fault() -> None:
    assert live(started(), 30.0, lambda t: min(250.0, 20.0 + 60.0 * t), 250.0, 1.0) == ""


def test_silence_is_a_fault_after_its_time_and_not_before() -> None:
    state = started()
    assert supervise.watch(PARAMETERS, state, 0.9, 100.0, 200.0, 0.5) == ""
    assert "no samples" in supervise.watch(PARAMETERS, state, 1.1, 100.0, 200.0, 0.5)


def test_blocks_without_a_believable_temperature_are_a_fault_with_the_reason() -> None:
    state = started()
    fault = ""
    for n in range(200):
        supervise.observe(PARAMETERS, state, n * 0.017, bad("signal clipped"))
        fault = supervise.watch(PARAMETERS, state, n * 0.017, 100.0, 200.0, 0.5)
        if fault:
            break
    assert "signal clipped" in fault
    assert n * 0.017 == pytest.approx(2.0, abs=0.05)


def test_off_blocks_alone_do_not_count_as_silence() -> None:
    state = started()
    for n in range(100):
        supervise.observe(PARAMETERS, state, n * 0.017, None)
        assert "no samples" not in supervise.watch(PARAMETERS, state, n * 0.017, 100.0, 0.0, 0.0)


@pytest.mark.parametrize(("temp", "words"), [(300.5, "above max_temp"), (-0.5, "below min_temp")])
def test_limits_trip_on_the_third_block_in_a_row(temp: float, words: str) -> None:
    state = started()
    sequence = [temp, temp, 100.0, temp, temp]
    assert [supervise.observe(PARAMETERS, state, 0.1, good(t)) for t in sequence] == [""] * 5
    assert words in supervise.observe(PARAMETERS, state, 0.1, good(temp))


def test_power_without_warmth_is_a_fault() -> None:
    assert "heating too slow" in live(started(), 5.0, lambda t: 25.0, 250.0, 1.0)


def test_half_a_degree_a_second_under_full_power_is_too_slow_and_one_is_not() -> None:
    assert "too slow" in live(started(), 10.0, lambda t: 25.0 + 0.5 * t, 250.0, 1.0)
    assert live(started(), 10.0, lambda t: 25.0 + 1.0 * t, 250.0, 1.0) == ""


def test_warmth_without_power_is_a_fault_and_cooling_is_not() -> None:
    assert "stuck on" in live(started(), 5.0, lambda t: 25.0 + 20.0 * t, 0.0, 0.0)
    assert live(started(), 5.0, lambda t: 250.0 - 10.0 * t, 0.0, 0.0) == ""


def test_a_fault_stays() -> None:
    state = started()
    first = supervise.watch(PARAMETERS, state, 5.0, 100.0, 200.0, 0.5)
    assert first
    assert live(state, 1.0, lambda t: 200.0, 200.0, 0.1) == first
