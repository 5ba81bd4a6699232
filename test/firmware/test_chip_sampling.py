"""The STM32F334 image samples the bridge while an axis steps: every sum, sample and phase, and what it costs."""

from __future__ import annotations

import pytest

from chip_rig import FREQ
from measure import PERIOD, TRAVEL, Sampling, everything_cost, run_sampling

SECONDS = 1.5  # ten in scripts/bench/bench_firmware.py
SAMPLES_IRQ = 16 + 11  # DMA1 channel 1
BLOCK, Y = 192, 5
MAX_PER_SAMPLE_TESTED = 4.6
MAX_PER_SAMPLE = 4.0  # a plain loop over the samples is 4.5 alone


@pytest.fixture(scope="module")
def run() -> Sampling:
    """120 kHz sampling, an axis at 50,000 steps a second, thirty phases a second, all of it reported."""
    return run_sampling(SECONDS, (BLOCK, 2))


def test_every_block_is_the_exact_sum_of_the_samples_injected(run: Sampling) -> None:
    checked = 0
    for clock, row in run.records:
        # the converter is triggered two ticks after the period's edge, whose clock the record has
        samples = [run.given.get(clock + 2 + i * PERIOD) for i in range(row.count)]
        known = [s for s in samples if s is not None]
        if len(known) < row.count:
            assert clock < min(run.given), "a block covers samples that were never taken"
            continue  # it began before the recording
        assert row.value == sum(known) * (BLOCK if row.count < BLOCK else row.count) // row.count >> Y or (
            row.value == sum(known) >> Y
        )
        assert (row.low, row.high) == (min(known), max(known))
        checked += 1
    assert checked > SECONDS * 400


def test_no_sample_is_lost_and_none_counted_twice(run: Sampling) -> None:
    assert run.after["samples_lost"] == 0
    assert sum(row.lost for _, row in run.records) == 0
    for (clock, row), (next_clock, following) in zip(run.records, run.records[1:], strict=False):
        assert next_clock == clock + (row.count + following.discarded) * PERIOD


def test_all_steps_are_made_meanwhile(run: Sampling) -> None:
    assert run.steps_made == run.steps_asked > 0.9 * TRAVEL * SECONDS


def test_steps_keep_their_time_beside_the_sampling(run: Sampling) -> None:
    """The sampling interrupt makes a step wait for its length at most: below 100 µs."""
    edges = [clock for clock, _ in run.chip.edges(16)][1:]  # the first is the pin's set-up
    first = edges[0]
    lateness = [clock - (first + n * (FREQ // TRAVEL)) for n, clock in enumerate(edges)]
    assert (max(lateness) - min(lateness)) / FREQ < 100e-6


def test_the_phases_in_the_compare_registers_are_those_commanded(run: Sampling) -> None:
    assert len({asked for asked, _, _ in run.phases}) > 20
    for asked, reported, lag in run.phases:
        assert lag == (asked * 19200 + 22500) // 45000  # 180 degrees are half of 38400 steps
        assert abs(reported - asked) <= 2  # a step is 2.3 units of the phase


def test_a_sample_costs_few_instructions(run: Sampling) -> None:
    """All of the interrupt: entry, sums, extremes, blocks, guard, exit."""
    assert run.spent(SAMPLES_IRQ) / run.samples <= MAX_PER_SAMPLE


def test_tests_of_the_signal_cost_little_more_and_no_sample() -> None:
    tested = run_sampling(SECONDS / 3, (BLOCK, 2), tests=True)
    assert tested.spent(SAMPLES_IRQ) / tested.samples <= MAX_PER_SAMPLE_TESTED
    assert max(tested.after["longest_ticks"].values()) / FREQ < 100e-6
    assert tested.after["samples_lost"] == 0
    for (clock, row), (next_clock, following) in zip(tested.records, tested.records[1:], strict=False):
        assert next_clock == clock + (row.count + following.discarded) * PERIOD
    assert sum(row.discarded for _, row in tested.records) > 20 * 66, "tests were made"


@pytest.mark.parametrize(("block", "limit"), [((1024, 2), 4.0), ((192, 2), 6.1)])
def test_a_sample_costs_few_instructions_in_total(block: tuple[int, int], limit: float) -> None:
    """With the task that writes records, the checksum and the sending: 3.5 for blocks of 4^5 samples. For the short
    ones of the control loop, five times as many records, it is 5.6: the bound is that and a tenth."""
    assert 2.0 < everything_cost(block) < limit


def test_no_interrupt_takes_a_tenth_of_a_millisecond(run: Sampling) -> None:
    longest = max(run.after["longest_ticks"].values())
    assert longest / FREQ < 100e-6
    assert run.after["worst_latency_ticks"] / FREQ < 100e-6


def test_the_stack_keeps_a_quarter_free(run: Sampling) -> None:
    counters = run.chip.chip.counters()
    used = counters["stack_top"] - counters["stack_low"]
    assert 0 < used < 0.75 * (counters["stack_top"] - counters["stack_limit"])
