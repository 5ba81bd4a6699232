"""The promise in figures (scripts/bench/bench_thermometer.py), shorter than `make bench` runs it."""

from __future__ import annotations

import harness

import pytest

import bench_thermometer


@pytest.mark.parametrize("units", [1.0, 6.4])
def test_the_thermometer_keeps_its_promise_in_a_print_and_beats_the_published_chain(units: float) -> None:
    ours, eq5, same_law = bench_thermometer.run(units, 4.0)
    report = harness.Report()
    bench_thermometer.judge(ours, report)
    assert report.missed == []
    assert eq5.rms_c > 10.0 * ours.rms_c
    assert same_law.max_c > 3.0 * ours.max_c  # the chain's part, its law's error apart: at steps of the phase
    assert 4.0 < ours.power_percent < 6.0  # the promise is for 5 %
