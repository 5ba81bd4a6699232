"""Faults are named, latched, and only called when they are there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from chain_rig import FFI, LIB, new_chain, told
from thermal.sensing import blocks, supervision

PARAMETERS = supervision.SuperviseParameters(0.0, 300.0, limit_blocks=3)
CHAIN = told(new_chain(watch=PARAMETERS))


@dataclass
class Watched:
    """Supervision and what the blocks have shown it."""

    state: supervision.SuperviseState = field(default_factory=supervision.SuperviseState)
    seen: Any = field(default_factory=lambda: FFI.new("struct chain_watch *"))

    def __post_init__(self) -> None:
        supervision.start(self.state, self.seen, 0.0)

    def block(self, end_s: float, temp_c: float = 0.0, reason: str = "") -> None:
        raw = FFI.new("struct coil_block *")
        raw.end_s, raw.temp_c, raw.fault = end_s, temp_c, blocks.REASONS.index(reason)
        LIB.chain_watch_block(CHAIN, self.seen, raw)

    def watch(self, time_s: float, temp_c: float, target_c: float, power: float) -> str:
        return supervision.watch(PARAMETERS, self.state, self.seen, time_s, temp_c, target_c, power)

    def live(
        self, seconds: float, temp_of_time: Callable[[float], float], target: float, power: float
    ) -> str:
        """Feed a healthy stream of blocks with the given temperatures."""
        for n in range(round(seconds / 0.017)):
            t = n * 0.017
            temp = temp_of_time(t)
            self.block(t, temp)
            fault = self.watch(t, temp, target, power)
            if fault:
                return fault
        return ""


def test_a_healthy_climb_and_hold_gives_no_fault() -> None:
    assert Watched().live(30.0, lambda t: min(250.0, 20.0 + 60.0 * t), 250.0, 1.0) == ""


def test_silence_is_a_fault_after_its_time_and_not_before() -> None:
    on = Watched()
    assert on.watch(0.9, 100.0, 200.0, 0.5) == ""
    assert "no samples" in on.watch(1.1, 100.0, 200.0, 0.5)


def test_blocks_without_a_believable_temperature_are_a_fault_with_the_reason() -> None:
    on = Watched()
    fault = ""
    for n in range(200):
        on.block(n * 0.017, reason="signal clipped")
        fault = on.watch(n * 0.017, 100.0, 200.0, 0.5)
        if fault:
            break
    assert "signal clipped" in fault
    assert n * 0.017 == pytest.approx(2.0, abs=0.05)


def test_off_blocks_alone_do_not_count_as_silence() -> None:
    on = Watched()
    for n in range(100):
        on.block(n * 0.017, reason="bridge off")
        assert "no samples" not in on.watch(n * 0.017, 100.0, 0.0, 0.0)


@pytest.mark.parametrize(("temp", "words"), [(305.5, "above max_temp"), (-0.5, "sensing lead open")])
def test_limits_trip_on_the_third_block_in_a_row(temp: float, words: str) -> None:
    on = Watched()
    for seen_c in (temp, temp, 100.0, temp, temp):
        on.block(0.1, seen_c)
        assert on.watch(0.1, seen_c, 200.0, 0.1) == ""
    on.block(0.1, temp)
    assert words in on.watch(0.1, temp, 200.0, 0.1)


def test_the_noise_of_a_nozzle_held_at_max_temp_is_no_fault() -> None:
    on = Watched()
    for _ in range(20):
        on.block(0.1, 304.5)
        assert on.watch(0.1, 304.5, 300.0, 0.1) == ""


def test_power_without_warmth_is_a_fault() -> None:
    assert "heating too slow" in Watched().live(5.0, lambda t: 25.0, 250.0, 1.0)


def test_half_a_degree_a_second_under_full_power_is_too_slow_and_one_is_not() -> None:
    assert "too slow" in Watched().live(10.0, lambda t: 25.0 + 0.5 * t, 250.0, 1.0)
    assert Watched().live(10.0, lambda t: 25.0 + 1.0 * t, 250.0, 1.0) == ""


def test_warmth_without_power_is_a_fault_and_cooling_is_not() -> None:
    assert "stuck on" in Watched().live(5.0, lambda t: 25.0 + 20.0 * t, 0.0, 0.0)
    assert Watched().live(5.0, lambda t: 250.0 - 10.0 * t, 0.0, 0.0) == ""


def test_a_fault_stays() -> None:
    on = Watched()
    first = on.watch(5.0, 100.0, 200.0, 0.5)
    assert first
    assert on.live(1.0, lambda t: 200.0, 200.0, 0.1) == first
