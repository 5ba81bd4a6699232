"""`control: two_period` on the induction nozzle: a law that swings, under the one guard that is its own."""

from __future__ import annotations

from pathlib import Path

import pytest

from system.conftest import Simulate

TWO_PERIOD = "induction_heater nozzle.control=two_period"
STRONG = ("simulator nozzle nozzle.preset=strong", "induction_heater nozzle.power_full_w=282")


@pytest.mark.parametrize(("cutoff_c", "low_c", "high_c"), [(15.0, 260.0, 275.0), (2.0, 250.0, 258.0)])
def test_the_cutoff_bounds_the_swing_and_m109_ends(
    simulate: Simulate, tmp_path: Path, cutoff_c: float, low_c: float, high_c: float
) -> None:
    """Table 2 heats at 82 % above the target too, so the swing sits at the cutoff; on top 10 ms of 282 W, 7 degC."""
    settings = (TWO_PERIOD, *STRONG, f"induction_heater nozzle.two_period_cutoff={cutoff_c}")
    run = simulate("M109 S250\nG4 P5000\n", settings=settings)
    assert run.status == 0, run.stderr
    assert run.column("t_s")[-1] < 12.0  # M109 took its climb and a second or so, then the 5 s
    true = run.column("true_c")
    assert low_c < max(true) < high_c
    assert "heater" not in run.stderr.lower()


def test_without_more_words_it_has_the_published_table_and_a_cutoff_of_15(
    simulate: Simulate, tmp_path: Path
) -> None:
    run = simulate("M109 S250\nG4 P4000\n", settings=(TWO_PERIOD,))
    assert run.status == 0, run.stderr
    assert 255.0 < max(run.column("true_c")) < 275.0


def test_an_impossible_cutoff_is_refused_by_name(simulate: Simulate) -> None:
    run = simulate("G4 P100\n", settings=(TWO_PERIOD, "induction_heater nozzle.two_period_cutoff=-1"))
    assert run.status == 2
    assert "two_period_cutoff" in run.stderr + run.stdout
