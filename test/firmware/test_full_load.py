"""The whole of it at once on the STM32F334 image: print, heat, sample at 120 kHz, and 50,000 steps/s beside it."""

from __future__ import annotations

import pytest

from chip_rig import FREQ
from full_load import TARGET_C, TRAVEL_HZ, Load, check_blocks, check_continuity, check_phases, play

SECONDS = 2.0  # ten in scripts/bench/bench_firmware.py


@pytest.fixture(scope="module")
def load(tmp_path_factory: pytest.TempPathFactory) -> Load:
    return play(tmp_path_factory.mktemp("full"), SECONDS)


def test_the_print_ends_and_every_motor_has_moved_meanwhile(load: Load) -> None:
    assert load.outcome.status == 0, load.outcome.reason
    (begin_s, begin, _), (end_s, end, _) = load.spinning()[0], load.spinning()[-1]
    assert end_s - begin_s >= 0.5 * SECONDS
    assert (end["spinner"] - begin["spinner"]) / (end_s - begin_s) == pytest.approx(TRAVEL_HZ, rel=1e-3)
    assert load.looks[-1][1]["spinner"] == TRAVEL_HZ * SECONDS
    for axis in ("x", "y", "extruder"):  # a square a second, a layer between them
        assert end[axis] > begin[axis]


def test_every_block_is_the_exact_sum_of_the_samples_injected(load: Load) -> None:
    assert check_blocks(load) == len(load.blocks) > 500 * SECONDS


def test_no_sample_is_lost_and_none_sent_twice(load: Load) -> None:
    check_continuity(load)


def test_the_legs_lag_by_the_phases_commanded(load: Load) -> None:
    assert check_phases(load) > 50


def test_the_nozzle_keeps_its_temperature(load: Load) -> None:
    for _, _, nozzle_c in load.spinning():
        assert nozzle_c == pytest.approx(TARGET_C, abs=3.0)


def test_no_interrupt_takes_or_waits_a_tenth_of_a_millisecond(load: Load) -> None:
    assert max(load.counters["longest_ticks"].values()) / FREQ < 100e-6
    assert load.counters["worst_latency_ticks"] / FREQ < 100e-6


def test_the_stack_keeps_a_quarter_free(load: Load) -> None:
    counters = load.counters
    used = counters["stack_top"] - counters["stack_low"]
    assert 0 < used < 0.75 * (counters["stack_top"] - counters["stack_limit"])
