"""Faults are named, latched, and only called when they are there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from chain_rig import FFI, LIB, c_params, new_chain
from thermal.sensing import blocks, supervision

PARAMETERS = supervision.SuperviseParameters(0.0, 300.0)


@dataclass
class Watched:
    """Supervision and what the blocks have shown it."""

    parameters: supervision.SuperviseParameters = PARAMETERS
    state: supervision.SuperviseState = field(default_factory=supervision.SuperviseState)
    seen: Any = field(default_factory=lambda: FFI.new("struct chain_watch *"))

    def __post_init__(self) -> None:
        self.chain = c_params(new_chain(watch=self.parameters))
        supervision.start(self.state, self.seen, 0.0)

    def block(self, end_s: float, temp_c: float = 0.0, reason: str = "", sigma_c: float = 0.0) -> None:
        raw = FFI.new("struct coil_block *")
        raw.end_s, raw.temp_c, raw.fault, raw.sigma_c = end_s, temp_c, blocks.REASONS.index(reason), sigma_c
        LIB.chain_watch_block(self.chain, self.seen, raw)

    def watch(self, time_s: float, temp_c: float, target_c: float, power: float) -> str:
        return supervision.watch(self.parameters, self.state, self.seen, time_s, temp_c, target_c, power)

    def see(self, time_s: float, temp_c: float, target_c: float, power: float) -> str:
        """A good block that ends now, and a look."""
        self.block(time_s, temp_c)
        return self.watch(time_s, temp_c, target_c, power)

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
    assert on.see(2.0, 100.0, 200.0, 0.4) == ""
    assert on.watch(3.0, 100.0, 200.0, 0.4) == ""
    assert on.watch(3.001, 100.0, 200.0, 0.4) == "no samples from the induction unit for 1.0 s"


def test_blocks_without_a_valid_temperature_are_a_fault_with_the_reason() -> None:
    on = Watched()
    fault = ""
    for n in range(200):
        on.block(n * 0.017, reason="signal clipped")
        fault = on.watch(n * 0.017, 100.0, 200.0, 0.5)
        if fault:
            break
    assert "signal clipped" in fault
    assert n * 0.017 == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize(
    ("reason", "words"), [("samples lost", "samples lost"), ("bridge off", "no usable block")]
)
def test_blocks_that_say_nothing_are_a_fault_after_two_seconds(reason: str, words: str) -> None:
    """Off blocks cannot say anything: they are no silence, and what was wrong before is not theirs."""
    on = Watched()
    on.block(0.5, 100.0)
    on.block(2.5, reason=reason)
    assert on.watch(2.5, 100.0, 0.0, 0.0) == ""
    assert on.watch(2.501, 100.0, 0.0, 0.0) == f"no valid nozzle temperature for 2.0 s ({words})"


def test_what_was_wrong_is_named_though_the_bridge_is_off_now() -> None:
    on = Watched()
    on.block(0.1, reason="signal clipped")
    on.block(2.1, reason="bridge off")
    assert "(signal clipped)" in on.watch(2.1, 100.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("within", "beyond", "words"),
    [
        (305.0, 305.5, "nozzle at 305.5 C, more than 5 C above max_temp 300.0 C"),
        (
            0.0,
            -0.5,
            "the coil's signal reads -0.5 C, below min_temp 0.0 C: is the coil or its sensing lead open",
        ),
    ],
)
def test_limits_trip_on_the_sixth_block_in_a_row(within: float, beyond: float, words: str) -> None:
    on = Watched()
    for temp_c in [beyond] * 5 + [within] + [beyond] * 5:
        assert on.see(0.1, temp_c, 200.0, 0.1) == ""
    on.block(0.1, 100.0, reason="signal clipped")  # says nothing, so it does not end the row
    on.block(0.1, beyond)
    on.block(0.1, 100.0)  # comes too late
    assert words in on.watch(0.1, 100.0, 200.0, 0.1)


@pytest.mark.parametrize(
    ("temp_c", "sigma_c", "trips"),
    [(320.0, 11.0, False), (-20.0, 11.0, False), (325.0, 9.0, True), (-25.0, 9.0, True), (307.0, 4.9, True)],
)
def test_a_reading_in_doubt_passes_a_limit_by_twice_its_doubt(
    temp_c: float, sigma_c: float, trips: bool
) -> None:
    on = Watched()
    for _ in range(20):
        on.block(0.1, temp_c, sigma_c=sigma_c)
    assert on.seen.is_tripped == trips


def test_the_temperature_that_tripped_is_kept_and_blocks_still_count() -> None:
    on = Watched(supervision.SuperviseParameters(0.0, 300.0, limit_blocks=1))
    on.block(0.1, 306.0)
    on.block(5.0, 307.0)
    assert (on.seen.is_tripped, on.seen.tripped_c, on.seen.last_block_s) == (1, 306.0, 5.0)


def test_without_a_calibration_only_silence_is_a_fault() -> None:
    on = Watched(supervision.SuperviseParameters(0.0, 300.0, calibrated=False))
    for n in range(60):
        on.block(0.1 * n, 1000.0, reason="outside the range of the sensing law: wrong nozzle, or its"
                 " thermometer is not calibrated?")  # fmt: skip
        assert on.watch(0.1 * n, 100.0, 250.0, 1.0) == ""
        assert on.watch(0.1 * n, 100.0 + 20.0 * n, 0.0, 0.0) == ""
    assert "no samples" in on.watch(7.0, 100.0, 250.0, 1.0)


@pytest.mark.parametrize(("target", "power"), [(250.0, 1.0), (0.0, 0.0)])
def test_before_the_first_temperature_nothing_is_said_of_warming(target: float, power: float) -> None:
    on = Watched()
    for time_s in (0.0, 1.0, 2.0):
        assert on.watch(time_s, math.nan, target, power) == ""
        on.block(time_s, reason="bridge off")
    assert on.state.demand_s == on.state.off_s == math.inf


@pytest.mark.parametrize(("target", "power"), [(250.0, 1.0), (0.0, 0.0)])
def test_without_a_calibration_nothing_is_said_of_warming(target: float, power: float) -> None:
    on = Watched(supervision.SuperviseParameters(0.0, 300.0, calibrated=False))
    for n in range(60):
        assert on.see(0.1 * n, 100.0 if target else 20.0 + 4.0 * n, target, power) == ""


def test_a_new_start_forgets_silence_counts_and_windows() -> None:
    on = Watched()
    for _ in range(5):
        on.block(0.1, 306.0)
    assert on.watch(0.1, 100.0, 250.0, 1.0) == ""  # a window of demand begins
    supervision.start(on.state, on.seen, 50.0)
    assert on.watch(51.0, math.nan, 250.0, 1.0) == ""  # a received and valid block at the start
    on.block(51.0, 306.0)
    assert on.watch(51.0, 100.0, 250.0, 1.0) == ""  # one beyond; the demand begins here
    assert on.see(53.9, 100.0, 250.0, 1.0) == ""
    assert "too slow" in on.see(54.0, 100.0, 250.0, 1.0)
    on = Watched()
    assert on.see(0.1, 20.0, 0.0, 0.0) == ""
    supervision.start(on.state, on.seen, 0.2)
    assert on.see(0.3, 60.0, 0.0, 0.0) == ""  # the window with the heater off begins here


def test_the_noise_of_a_nozzle_held_at_max_temp_is_no_fault() -> None:
    on = Watched()
    for _ in range(20):
        on.block(0.1, 304.5)
        assert on.watch(0.1, 304.5, 300.0, 0.1) == ""


def test_power_without_warmth_is_a_fault() -> None:
    assert "heating too slow" in Watched().live(5.0, lambda t: 25.0, 250.0, 1.0)


def test_under_demand_the_nozzle_must_warm_by_two_degrees_within_three_seconds() -> None:
    on = Watched()
    assert on.see(10.0, 100.0, 200.0, 0.5) == ""
    assert on.see(12.5, 102.0, 200.0, 0.5) == ""  # warm enough: a new window
    assert on.see(15.4, 103.9, 200.0, 0.5) == ""
    fault = on.see(15.5, 103.9, 200.0, 0.5)
    assert fault.startswith("heating too slow: +1.9 C in 3 s at 104 C")


@pytest.mark.parametrize(
    ("target", "power", "words"), [(105.1, 0.5, "too slow"), (105.0, 0.5, ""), (200.0, 0.49, "")]
)
def test_demand_is_half_of_full_power_and_more_than_five_degrees(
    target: float, power: float, words: str
) -> None:
    on = Watched()
    faults = [on.see(0.1 * n, 100.0, target, power) for n in range(32)]
    assert words in faults[-1] and bool(faults[-1]) == bool(words)


def test_a_pause_in_the_demand_begins_its_window_anew() -> None:
    on = Watched()
    for time_s, power in ((0.0, 1.0), (2.0, 0.0), (4.0, 1.0), (6.9, 1.0)):
        assert on.see(time_s, 100.0, 200.0, power) == ""
    assert "too slow" in on.see(7.0, 100.0, 200.0, 1.0)


def test_with_the_heater_off_the_nozzle_may_not_warm_by_fifteen_degrees_in_two_seconds() -> None:
    on = Watched()
    assert on.see(10.0, 25.0, 0.0, 0.0) == ""
    assert on.see(12.0, 39.9, 0.0, 0.0) == ""
    assert on.see(12.0, 40.0, 0.0, 0.0) == "nozzle warms with the heater off (40 C): is the bridge stuck on?"
    on = Watched()
    assert on.see(10.0, 25.0, 0.0, 0.0) == ""
    assert on.see(12.001, 45.0, 0.0, 0.0) == ""  # a new window
    assert on.see(14.0, 59.9, 0.0, 0.0) == ""
    assert "stuck on" in on.see(14.001, 60.0, 0.0, 0.0)


def test_warming_counts_from_the_coldest_with_the_heater_off() -> None:
    on = Watched()
    for time_s, temp_c in ((0.0, 50.0), (1.5, 30.0), (2.5, 30.0), (3.4, 44.9)):
        assert on.see(time_s, temp_c, 0.0, 0.0) == ""
    assert "stuck on" in on.see(3.5, 45.0, 0.0, 0.0)


@pytest.mark.parametrize(("target", "power"), [(1.0, 0.0), (0.0, 0.01), (1.0, 1.0)])
def test_a_heater_that_is_on_may_warm_and_afterwards_the_window_begins_anew(
    target: float, power: float
) -> None:
    on = Watched()
    assert on.see(0.0, 25.0, 0.0, 0.0) == ""
    assert on.see(1.0, 60.0, target, power) == ""
    assert on.see(1.5, 60.0, 0.0, 0.0) == ""
    assert "stuck on" in on.see(1.6, 75.0, 0.0, 0.0)


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


def test_a_host_that_slept_for_longer_than_a_silence_may_last_is_named_itself() -> None:
    parameters, state = supervision.SuperviseParameters(0.0, 300.0), supervision.SuperviseState()
    supervision.watch_host(parameters, state, parameters.silence_s)
    assert not state.fault
    supervision.watch_host(parameters, state, 1.3)
    assert state.fault == "no control for 1.3 s: the computer was too busy, or the host program was stopped"
    supervision.watch_host(parameters, state, 4.0)
    assert "1.3 s" in state.fault, "the first fault stays"


@pytest.mark.parametrize(("over_w", "after_s"), [(80.0, 0.04), (250.0, 0.015), (10.0, 0.32)])
def test_a_drive_beyond_all_commands_is_a_fault_once_it_may_warm_by_eight_degrees(
    over_w: float, after_s: float
) -> None:
    watched = Watched()
    for n in range(400):
        time_s = n * 0.005
        supervision.watch_drive(watched.parameters, watched.state, time_s, over_w, 0.4)
        if watched.state.fault:
            break
    assert time_s == pytest.approx(after_s, abs=0.0051)
    supervision.watch_drive(watched.parameters, watched.state, time_s + 1.0, 2.0 * over_w, 0.4)
    assert f"driven with {over_w:.0f} W more than any command" in watched.state.fault, "the first fault stays"


def test_a_late_command_or_one_that_is_not_known_is_no_drive_beyond_commands() -> None:
    watched = Watched()
    for n in range(400):
        over_w = 250.0 if n % 3 else (math.nan, -1.0)[n % 2]
        supervision.watch_drive(watched.parameters, watched.state, n * 0.005, over_w, 0.4)
    assert not watched.state.fault
