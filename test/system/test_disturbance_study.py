"""A sine on the reading of a held nozzle, through the whole stack with the firmware's guard.

config/studies/disturbance.toml has all frequencies and amplitudes.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from simulation.study.figures import collect
from system.conftest import ROOT, Simulate

PROGRAMME = ROOT / "config" / "studies" / "disturbance.gcode"
HELD = {"where": [["target_c", ">", 1.0], ["z_mm", ">", 1.999], ["z_mm", "<", 2.001]], "trace": "true_c"}
SETTINGS = ("simulator nozzle nozzle.preset=strong", "induction_heater nozzle.power_full_w=282")


@pytest.mark.parametrize(
    ("preset", "hz", "amplitude_c"),
    [("reference", 2.0, 0.25), ("reference", 1.0, 4.0), ("strong", 1.4, 1.0), ("strong", 20.0, 1.0)],
)
def test_a_sine_on_the_reading_is_hardly_amplified_and_does_not_move_the_mean(
    simulate: Simulate, tmp_path: Path, preset: str, hz: float, amplitude_c: float
) -> None:
    plant = "simulator nozzle nozzle"
    settings = [f"{plant}.emi_hz={hz}", f"{plant}.emi_lsb={0.795 * amplitude_c}", "simulator.trace_rate=200"]
    run = simulate(PROGRAMME.read_text(), settings=[*settings, *(SETTINGS if preset == "strong" else ())])
    assert run.status == 0, run.stderr
    sine = HELD | {"minus": "", "take": "sine", "hz": hz, "per": amplitude_c}
    mean = HELD | {"minus": "target_c", "take": "mean"}
    found = collect({"gain": sine, "shift_c": mean}, {}, run.trace)
    assert found["gain"] is not None and found["gain"] <= 1.5
    assert found["shift_c"] is not None and abs(found["shift_c"]) <= 0.3
