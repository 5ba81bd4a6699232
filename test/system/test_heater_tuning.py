"""PID_CALIBRATE, MODEL_CALIBRATE, HEATER_PROFILE and mcu_onoff through the whole split stack."""

from __future__ import annotations

import re
from pathlib import Path

from system.conftest import CONFIG, Simulate


def machine(folder: Path, more: str = "") -> Path:
    path = folder / "printer.cfg"
    path.write_text(f"[include {CONFIG}]\n{more}\n")
    return path


# A light bed, so that a run is short.
LIGHT = """
[simulator load bed]
element_j_k: 60
body_j_k: 40
"""


def test_a_bed_and_a_nozzle_find_their_gains_and_the_gains_hold(simulate: Simulate, tmp_path: Path) -> None:
    log = tmp_path / "host.log"
    gcode = (
        "PID_CALIBRATE HEATER=heater_bed TARGET=60\nHEATER_PROFILE HEATER=heater_bed SAVE=found\n"
        "PID_CALIBRATE HEATER=extruder TARGET=220\nM109 S220\nG4 P3000\nSAVE_CONFIG RESTART=0\n"
    )
    path = tmp_path / "printer.cfg"
    path.write_text(CONFIG.read_text() + LIGHT)  # SAVE_CONFIG does not edit included files
    run = simulate(gcode, config=path, more=["--log", str(log)])
    text = log.read_text()
    assert run.status == 0, run.stderr
    assert len(re.findall(r"PID parameters: ", text)) == 2
    saved = path.read_text()
    for option in ("pid_kp =", "pid_kp_w_per_k =", "[heater_profile heater_bed found]"):
        assert option in saved, saved
    again = simulate("HEATER_PROFILE LIST=1\nHEATER_PROFILE HEATER=heater_bed LOAD=found\n", config=path,
                     more=["--log", str(log)])  # fmt: skip
    assert again.status == 0, again.stderr
    assert "heater_bed found: control=pid" in log.read_text()


def test_a_bed_finds_its_model(simulate: Simulate, tmp_path: Path) -> None:
    log = tmp_path / "host.log"
    gcode = "MODEL_CALIBRATE HEATER=heater_bed TARGET=70 POWER=200 WAIT=1\n"
    run = simulate(gcode, config=machine(tmp_path, LIGHT), more=["--log", str(log)])
    text = log.read_text()
    assert run.status == 0, run.stderr
    heat = re.search(r"heat capacity, all, J/K +([0-9.]+)", text)
    loss = re.search(r"loss, W/K +([0-9.]+)", text)
    assert heat is not None and abs(float(heat[1]) - 100.0) < 8.0
    assert loss is not None and abs(float(loss[1]) - 1.2) < 0.08


def test_a_wrong_power_or_a_missing_one_is_said(simulate: Simulate, tmp_path: Path) -> None:
    run = simulate("MODEL_CALIBRATE HEATER=heater_bed WAIT=1\n", config=machine(tmp_path))
    assert "POWER= in watts" in run.stderr + run.stdout


def test_an_induction_nozzle_finds_its_model_within_two_minutes(simulate: Simulate, tmp_path: Path) -> None:
    log = tmp_path / "host.log"
    gcode = "MODEL_CALIBRATE HEATER=extruder TARGET=220 WAIT=1\n"
    run = simulate(gcode, config=machine(tmp_path), more=["--log", str(log)])
    text = log.read_text()
    assert run.status == 0, run.stderr
    heat = re.search(r"set \[induction_heater nozzle\] heat_capacity_j_per_k = ([0-9.]+)", text)
    assert heat is not None and abs(float(heat[1]) - 0.414) < 0.03, text[-2000:]
    assert run.column("t_s")[-1] < 120.0
    assert run.column("phase_ticks")[-1] < 3000


def test_the_mcu_switches_a_bed_by_itself(simulate: Simulate, tmp_path: Path) -> None:
    more = LIGHT + "[heater_bed]\ncontrol: mcu_onoff\n"
    run = simulate("M190 S60\nG4 P20000\n", config=machine(tmp_path, more))
    assert run.status == 0, run.stderr
