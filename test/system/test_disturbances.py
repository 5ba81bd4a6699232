"""What a real machine adds to the reading, one thing at a time, on whole simulated prints with the firmware's guard.

True skin temperature after the climb: held, with filament that begins to flow after a pause, and held again.
"""

from __future__ import annotations

import pytest

from system.conftest import Run, Simulate

CLIMB = "M104 S250\nTEMPERATURE_WAIT SENSOR=extruder MINIMUM=248\nG4 P1000\nM400\n"
HELD = "M109 S250\nG4 P1500\n"
PRINT = f"G28\nG1 X10 Y40 Z1 F6000\nM83\n{HELD}M400\nG1 X130 E6 F6000\nM400\nG4 P500\n"  # 12 mm3/s
STRONG = ("simulator nozzle nozzle.preset=strong", "induction_heater nozzle.power_full_w=282")
NOZZLE = "simulator nozzle nozzle."
CYCLES = "".join(f"M104 S250\nG4 P{1500 + 7 * i}\nM400\nM104 S0\nG4 P300\nM400\n" for i in range(6))
# A light, efficient nozzle and the law of its calibration.
LIGHT = {"mass_factor": 0.75, "efficiency_factor": 1.3, "bore_tau_s": 0.065}
LIGHT_LAW = {
    "estimator": "tank", "tank_g": 1140.158, "tank_t0": 388.0902, "tank_w": 1414.813, "tank_delta": 2.605436,
    "tank_b": 0.4546662, "tank_q": 0.6051056, "tank_c": -4.750432, "tank_d": 313.5991, "tank_m": 0.9941363,
    "law_residual": 0.0586, "heat_capacity_j_per_k": 0.2389, "loss_factor": 0.7927, "second_mass_factor": 0.7704,
    "ambient_temp": 23.54, "loss_uncertainty": 0.03,
}  # fmt: skip


def away_c(run: Run) -> list[float]:
    """True temperature less its target, from half a second after the nozzle first is at its target."""
    assert run.status == 0, run.stderr
    rows = list(zip(run.column("t_s"), run.column("true_c"), run.column("target_c"), strict=True))
    there_s = next(t for t, true_c, target_c in rows if target_c > 0.0 and true_c > target_c - 1.0)
    return [true_c - target_c for t, true_c, target_c in rows if t > there_s + 0.5]


@pytest.mark.parametrize(
    ("settings", "max_c"),
    [
        ((f"{NOZZLE}move_um=5", f"{NOZZLE}move_hz=20"), 0.5),
        ((*STRONG, f"{NOZZLE}move_um=5", f"{NOZZLE}move_hz=20"), 0.5),
        ((f"{NOZZLE}ripple_v=2", f"{NOZZLE}ripple_hz=100"), 3.0),
        ((f"{NOZZLE}noise_lsb=0",), 1.0),
        ((f"{NOZZLE}noise_lsb=0.05",), 1.0),
        (STRONG, 0.5),
    ],
    ids=["vibration", "vibration, strong", "ripple", "no noise", "little noise", "strong"],
)
def test_the_true_temperature_stays_while_the_reading_is_disturbed(
    simulate: Simulate, settings: tuple[str, ...], max_c: float
) -> None:
    away = away_c(simulate(PRINT, settings=settings))
    assert max(map(abs, away)) < max_c


@pytest.mark.parametrize(
    ("preset", "changes"),
    [
        ("reference", "ripple_v=2 ripple_hz=97"),
        ("reference", "ripple_v=2 ripple_hz=120"),
        ("reference", "emi_lsb=5 emi_hz=100"),
        ("strong", "ripple_v=1 ripple_hz=100"),
        ("strong", "ripple_v=2 ripple_hz=50"),
        ("strong", "ripple_v=2 ripple_hz=100"),
        ("strong", "emi_lsb=5 emi_hz=50"),
        ("strong", "emi_lsb=5 emi_hz=100"),
        ("light", "ripple_v=2 ripple_hz=100"),
        ("light", "supply_v=22.8"),
        ("light", "supply_ohm=0.03"),
    ],
)
def test_a_disturbed_climb_peaks_within_three_degrees(simulate: Simulate, preset: str, changes: str) -> None:
    """Without doubt about the readings at full drive most of these shut down, or peak at 253 to 278 degC."""
    settings = [f"{NOZZLE}preset={preset}", *(NOZZLE + change for change in changes.split())]
    if preset != "reference":
        settings.append("induction_heater nozzle.power_full_w=282")
    run = simulate(CLIMB, settings=settings)
    assert run.status == 0, run.stderr
    assert 249.0 < max(run.column("true_c")) < 253.0


def test_a_reading_that_swings_by_six_degrees_is_at_its_target_by_its_mean(simulate: Simulate) -> None:
    """M109 would otherwise wait for ever."""
    away = away_c(simulate(HELD, settings=[f"{NOZZLE}emi_lsb=5", f"{NOZZLE}emi_hz=50"]))
    assert max(map(abs, away[-100:])) < 3.0


def test_a_light_strong_nozzle_that_is_turned_off_gets_looks_only(simulate: Simulate) -> None:
    """An earlier version began a pulse 60 ms after target 0 and sent its end too late for the firmware."""
    settings = [*STRONG, "simulator.trace_rate=1000"]
    settings += [f"{NOZZLE}{name}={value}" for name, value in LIGHT.items()]
    settings += [f"induction_heater nozzle.{name}={value}" for name, value in LIGHT_LAW.items()]
    run = simulate(CYCLES, settings=settings)
    assert run.status == 0, run.stderr
    longest = on = 0
    for target_c, phase in zip(run.column("target_c"), run.column("phase_ticks"), strict=True):
        on = on + 1 if phase and not target_c else 0
        longest = max(longest, on)
    assert longest < 50  # ms: what was on its way as the target fell
