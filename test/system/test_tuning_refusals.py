"""Commands that tune heaters: a wrong word is told and harms nothing; a dead sensor is not heated."""

from __future__ import annotations

from pathlib import Path

import pytest

from system.conftest import CONFIG, Simulate


def play(simulate: Simulate, tmp_path: Path, lines: str, more: str = "") -> tuple[int, str, list[float]]:
    path, log = tmp_path / "printer.cfg", tmp_path / "log"
    path.write_text(f"[include {CONFIG}]\n{more}")
    run = simulate(lines, config=path, more=["--log", str(log)])
    power = run.column("power_w") if run.trace.exists() else []
    return run.status, log.read_text() + run.stderr, power


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("PID_CALIBRATE HEATER=oven TARGET=200", "Unknown heater 'oven'"),
        ("PID_CALIBRATE HEATER=extruder TARGET=20", "TARGET must be 10 C above"),
        ("PID_CALIBRATE HEATER=extruder TARGET=900", "TARGET"),
        ("PID_CALIBRATE HEATER=extruder", "TARGET"),
        ("MODEL_CALIBRATE HEATER=oven", "Unknown heater 'oven'"),
        ("MODEL_CALIBRATE", "HEATER"),
    ],
)
def test_a_bad_command_is_told_and_nothing_is_heated(
    simulate: Simulate, tmp_path: Path, line: str, words: str
) -> None:
    status, text, power = play(simulate, tmp_path, f"G4 P300\n{line}\n")
    assert status == 2 and words in text, text[-600:]
    assert max(power) < 2.0  # looks of 1.5 W, no heat


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("[induction_heater nozzle]\npid_kp_w_per_k: 0\ncontrol: pid\n", "pid_kp_w_per_k"),
        ("[induction_heater nozzle]\npid_ki_w_per_k_s: -1\ncontrol: pid\n", "pid_ki_w_per_k_s"),
        ("[induction_heater nozzle]\nheat_capacity_j_per_k: -0.4\n", "heat_capacity_j_per_k"),
        ("[induction_heater nozzle]\nloss_factor: 0\n", "loss_factor"),
        ("[induction_heater nozzle]\ncontrol: magic\n", "control"),
        ("[heater_bed]\npid_Kp: -1\n", "pid_kp"),
        ("[heater_bed]\ncontrol: watermark\nmax_delta: 0\n", "max_delta"),
    ],
)
def test_an_impossible_tuning_is_refused_by_name(
    simulate: Simulate, tmp_path: Path, more: str, words: str
) -> None:
    status, text, _ = play(simulate, tmp_path, "G4 P100\n", more)
    assert status == 2 and words in text.lower(), text[-600:]


def test_a_pid_run_of_the_nozzle_can_be_ended_and_run_again(simulate: Simulate, tmp_path: Path) -> None:
    lines = "PID_CALIBRATE HEATER=extruder TARGET=220 WAIT=0\nG4 P2500\nABORT\nG4 P500\n"
    status, text, power = play(simulate, tmp_path, lines * 2 + "G4 P500\n")
    assert status == 0, text[-600:]
    assert text.count("PID_CALIBRATE ended: ended by ABORT. Nothing was changed.") == 2
    assert max(power) > 50.0 and max(power[-20:]) < 2.0


def test_pid_gains_of_the_nozzle_hold_it(simulate: Simulate, tmp_path: Path) -> None:
    lines = "PID_CALIBRATE HEATER=extruder TARGET=220\nM109 S230\nG4 P5000\n"
    status, text, _ = play(simulate, tmp_path, lines)
    assert status == 0 and "set [induction_heater nozzle] pid_kp_w_per_k" in text
