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


BED_MODEL = (
    "[heater_bed]\ncontrol: model\nheater_power_w: {heater_power_w}\nmodel_heat_j_per_k: {model_heat_j_per_k}\n"
    "model_loss_w_per_k: {model_loss_w_per_k}\nmodel_element_j_per_k: {model_element_j_per_k}\n"
    "model_element_w_per_k: 11\nmodel_sensor_lag: {model_sensor_lag}\nmodel_ambient_temp: {model_ambient_temp}\n"
)
GOOD = {
    "heater_power_w": "200",
    "model_heat_j_per_k": "410",
    "model_loss_w_per_k": "1.2",
    "model_element_j_per_k": "110",
    "model_sensor_lag": "3",
    "model_ambient_temp": "22",
}


def test_a_bed_with_a_possible_model_is_accepted(simulate: Simulate, tmp_path: Path) -> None:
    status, text, _ = play(simulate, tmp_path, "G4 P100\n", BED_MODEL.format(**GOOD))
    assert status == 0, text[-600:]


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("heater_power_w", "0"),
        ("model_heat_j_per_k", "-410"),
        ("model_heat_j_per_k", "nan"),
        ("model_loss_w_per_k", "0"),
        ("model_loss_w_per_k", "-1"),
        ("model_element_j_per_k", "0"),
        ("model_sensor_lag", "-3"),
        ("model_ambient_temp", "-400"),
        ("heater_power_w", "much"),
    ],
)
def test_an_impossible_model_of_a_bed_is_refused_with_section_and_option(
    simulate: Simulate, tmp_path: Path, option: str, value: str
) -> None:
    status, text, _ = play(simulate, tmp_path, "G4 P100\n", BED_MODEL.format(**GOOD | {option: value}))
    said = text.lower()
    assert status == 2 and "heater_bed" in said and option in said, text[-600:]


@pytest.mark.parametrize("command", ["PID_CALIBRATE", "MODEL_CALIBRATE POWER=200"])
def test_a_bed_that_does_not_warm_its_sensor_ends_the_run(
    simulate: Simulate, tmp_path: Path, command: str
) -> None:
    broken = "[simulator load bed]\nfault: 3\n"
    lines = f"{command} HEATER=heater_bed TARGET=60 WAIT=1\nG4 P1000\n"
    status, text, _ = play(simulate, tmp_path, lines, broken)
    assert status == 3, text[-600:]
    assert "loose or broken heater or sensor" in text  # verify_heater's patience is the shorter one
    assert f"{command.split(maxsplit=1)[0]} ended: the printer stopped. Nothing was changed." in text
    assert "save_config: set" not in text


@pytest.mark.parametrize(("fault", "words"), [(1, "disconnected"), (2, "shorted")])
@pytest.mark.parametrize("command", ["PID_CALIBRATE", "MODEL_CALIBRATE POWER=200"])
def test_a_bed_with_a_dead_sensor_is_not_calibrated(
    simulate: Simulate, tmp_path: Path, command: str, fault: int, words: str
) -> None:
    lines = f"G4 P3000\n{command} HEATER=heater_bed TARGET=60 WAIT=1\nG4 P1000\n"
    status, text, _ = play(simulate, tmp_path, lines, f"[simulator load bed]\nfault: {fault}\n")
    assert status == 2 and "save_config: set" not in text
    assert words in text and "'heater_bed' reads" in text, text[-800:]


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
