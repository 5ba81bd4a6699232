"""A cold start on a machine that is not the one of the calibration: the looks at the sensing phase find the difference.

True skin temperature of whole simulated prints, the shipped calibration, one thing changed. Without looks the first row
peaks at 281 degC for 250, the second at 307, ripple at 296. The others shut down in the first 30 degC.
"""

from __future__ import annotations

import pytest

from conftest import Simulate

TARGET_C = 250.0
CLIMB = f"M104 S{TARGET_C:.0f}\nTEMPERATURE_WAIT SENSOR=extruder MINIMUM=248\nG4 P1500\nM400\n"


def climb(simulate: Simulate, *settings: str) -> tuple[float, float, float]:
    """(highest true temperature, mean over the last second, seconds from 30 to 245 degC)."""
    run = simulate(CLIMB, settings=[f"simulator nozzle nozzle.{text}" for text in settings])
    assert run.status == 0, run.stderr
    times_s, true_c = run.column("t_s"), run.column("true_c")
    start_s = next(t for t, c in zip(times_s, true_c, strict=True) if c > 30.0)
    there_s = next((t for t, c in zip(times_s, true_c, strict=True) if c > 235.0), float("inf"))
    last = [c for t, c in zip(times_s, true_c, strict=True) if t > times_s[-1] - 1.0]
    return max(true_c), sum(last) / len(last), there_s - start_s


@pytest.mark.parametrize(
    "changes",
    [
        ("supply_v=24.5",),
        ("supply_v=25.0",),
        ("supply_v=23.5",),
        ("supply_ohm=0.03",),
        ("ripple_v=1", "ripple_hz=100"),
        ("ripple_v=1", "ripple_hz=120"),
        ("preset=strong", "supply_v=24.5"),
    ],
    ids=["2 % more", "4 % more", "2 % less", "sag", "ripple", "120 Hz", "strong, 2 % more"],
)
def test_a_supply_nobody_measures_moves_the_peak_by_less_than_three_degrees(
    simulate: Simulate, changes: tuple[str, ...]
) -> None:
    peak_c, held_c, _ = climb(simulate, *changes)
    assert peak_c < TARGET_C + 3.0
    assert abs(held_c - TARGET_C) < 1.0


def test_a_capacitor_off_by_a_warm_afternoon_is_no_reason_to_shut_down(simulate: Simulate) -> None:
    """+0.05 % of C1 reads 23 degC too cold at full drive and 7.7 at little: the climb follows the little drive. What is
    left is the drift of the thermometer itself, which looks at the drive cannot show."""
    peak_c, held_c, _ = climb(simulate, "c1_factor=1.0005")
    assert peak_c < held_c + 1.0
    assert held_c == pytest.approx(TARGET_C + 7.7, abs=0.5)


def test_looks_cost_less_than_three_percent_of_a_climb(simulate: Simulate) -> None:
    """1.7 % of the time of a long climb has the sensing phase, and the drive begins with one."""
    _, _, looked_s = climb(simulate)
    blocks = "induction_heater nozzle.oversample=7"  # blocks too long for looks
    run = simulate(CLIMB, settings=[blocks, "induction_heater nozzle.block_samples=2048"])
    assert run.status == 0, run.stderr
    times_s, true_c = run.column("t_s"), run.column("true_c")
    start_s = next(t for t, c in zip(times_s, true_c, strict=True) if c > 30.0)
    plain_s = next(t for t, c in zip(times_s, true_c, strict=True) if c > 235.0) - start_s
    assert looked_s < 1.03 * plain_s
