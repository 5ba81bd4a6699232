"""PID_CALIBRATE, MODEL_CALIBRATE, HEATER_PROFILE and mcu_onoff through the whole split stack."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from system.conftest import CONFIG, Simulate, machine

MEGA = CONFIG.parent / "sim-mega.cfg"


# A light bed, so that a run is short.
LIGHT = """
[simulator load bed]
element_j_k: 60
body_j_k: 40
"""


def test_a_bed_and_a_nozzle_find_their_gains_and_the_gains_hold(simulate: Simulate, tmp_path: Path) -> None:
    gcode = (
        "PID_CALIBRATE HEATER=heater_bed TARGET=60\nHEATER_PROFILE HEATER=heater_bed SAVE=found\n"
        "PID_CALIBRATE HEATER=extruder TARGET=220\nM109 S220\nG4 P3000\nSAVE_CONFIG RESTART=0\n"
    )
    path = tmp_path / "printer.cfg"
    path.write_text(CONFIG.read_text() + LIGHT)  # SAVE_CONFIG does not edit included files
    run = simulate(gcode, config=path)
    text = run.log.read_text()
    assert run.status == 0, run.stderr
    assert len(re.findall(r"PID parameters: ", text)) == 2
    saved = path.read_text()
    for option in ("pid_kp =", "pid_kp_w_per_k =", "[heater_profile heater_bed found]"):
        assert option in saved, saved
    again = simulate("HEATER_PROFILE LIST=1\nHEATER_PROFILE HEATER=heater_bed LOAD=found\n", config=path)
    assert again.status == 0, again.stderr
    assert "heater_bed found: control=pid" in again.log.read_text()


def test_a_bed_finds_its_model(simulate: Simulate, tmp_path: Path) -> None:
    gcode = "MODEL_CALIBRATE HEATER=heater_bed TARGET=70 POWER=200 WAIT=1\n"
    run = simulate(gcode, config=machine(tmp_path, LIGHT))
    text = run.log.read_text()
    assert run.status == 0, run.stderr
    heat = re.search(r"heat capacity, all, J/K +([0-9.]+)", text)
    loss = re.search(r"loss, W/K +([0-9.]+)", text)
    assert heat is not None and abs(float(heat[1]) - 100.0) < 8.0
    assert loss is not None and abs(float(loss[1]) - 1.2) < 0.08
    # heat is lost at two places where the model has one: the share for the model's shape is needed here
    within_three_sigma(text, "heat capacity, all, J/K", 100.0)
    within_three_sigma(text, "loss, W/K", 1.2)


def reported(text: str, label: str) -> tuple[float, float]:
    """(value, printed 1 sigma) of the line of MODEL_CALIBRATE's report that begins so."""
    match = re.search(rf"{re.escape(label)} +([0-9.e+-]+) \+- ([0-9.e+-]+)", text)
    assert match is not None, text[-2000:]
    return float(match[1]), float(match[2])


def within_three_sigma(text: str, label: str, true: float) -> None:
    value, sigma = reported(text, label)
    assert abs(value - true) < 3.0 * sigma, (label, value, sigma)
    assert sigma < 0.03 * true, (label, sigma)  # and the doubt is not so wide that it says nothing


@pytest.mark.parametrize(("mass", "loss"), [(1.3, 0.7), (0.7, 1.3)])
def test_another_nozzle_lies_within_three_sigma_of_what_is_reported(
    simulate: Simulate, tmp_path: Path, mass: float, loss: float
) -> None:
    plant = "simulator nozzle nozzle."
    settings = (f"{plant}mass_factor={mass}", f"{plant}loss_factor={loss}")
    gcode = "MODEL_CALIBRATE HEATER=extruder TARGET=220 WAIT=1\n"
    run = simulate(gcode, settings=settings)
    assert run.status == 0, run.stderr
    text = run.log.read_text()
    within_three_sigma(text, "heat capacity at 25 C, J/K", 0.414 * mass)
    within_three_sigma(text, "losses, x reference", loss)


def test_another_hotend_lies_within_three_sigma_of_what_is_reported(
    simulate: Simulate, tmp_path: Path
) -> None:
    """A quarter heavier, a quarter less loss: 2.5 + 18.75 J/K, 52.9 mW/K, fan untouched."""
    plant = "simulator load extruder."
    settings = (f"{plant}mass_factor=1.25", f"{plant}loss_factor=0.75")
    gcode = "MODEL_CALIBRATE HEATER=extruder TARGET=200 WAIT=1 POWER=40 FAN=1\n"
    run = simulate(gcode, config=MEGA, settings=settings)
    assert run.status == 0, run.stderr
    text = run.log.read_text()
    within_three_sigma(text, "heat capacity, all, J/K", 21.25)
    within_three_sigma(text, "loss, W/K", 0.75 * 0.0705)
    within_three_sigma(text, "fan at full speed, W/K", 0.030)


def test_a_fan_that_is_on_is_off_for_a_run_that_measures_it_and_comes_back(
    simulate: Simulate, tmp_path: Path
) -> None:
    """A light hotend, so that the run is short."""
    gcode = (
        "M106 S128\nG4 P2000\nMODEL_CALIBRATE HEATER=extruder TARGET=150 WAIT=1 POWER=40 FAN=1\nG4 P2000\n"
    )
    run = simulate(gcode, config=MEGA, settings=("simulator load extruder.body_j_k=6",))
    assert run.status == 0, run.stderr
    within_three_sigma(run.log.read_text(), "loss, W/K", 0.0705)
    within_three_sigma(run.log.read_text(), "fan at full speed, W/K", 0.030)
    fan = run.column("fan")
    assert fan[-1] == pytest.approx(128.0 / 255.0, abs=0.01) and min(fan[len(fan) // 4 :]) == 0.0


def test_a_wrong_power_or_a_missing_one_is_said(simulate: Simulate, tmp_path: Path) -> None:
    run = simulate("MODEL_CALIBRATE HEATER=heater_bed WAIT=1\n", config=machine(tmp_path))
    assert "POWER= in watts" in run.stderr + run.stdout


def test_an_induction_nozzle_finds_its_model_within_two_minutes(simulate: Simulate, tmp_path: Path) -> None:
    gcode = "MODEL_CALIBRATE HEATER=extruder TARGET=220 WAIT=1\n"
    run = simulate(gcode, config=machine(tmp_path))
    text = run.log.read_text()
    assert run.status == 0, run.stderr
    heat = re.search(r"set \[induction_heater nozzle\] heat_capacity_j_per_k = ([0-9.]+)", text)
    assert heat is not None and abs(float(heat[1]) - 0.414) < 0.03, text[-2000:]
    assert run.column("t_s")[-1] < 120.0
    assert run.column("phase_ticks")[-1] < 3000


LOOK = """
[gcode_macro LOOK]
gcode:
  {% set nozzle = printer["induction_heater nozzle"] %}
  { action_respond_info("driven by %s, unexplained %s" % (nozzle.control, nozzle.disturbance_w)) }
"""


def test_a_nozzles_status_can_be_asked_for_during_its_calibration(simulate: Simulate, tmp_path: Path) -> None:
    gcode = "LOOK\nMODEL_CALIBRATE HEATER=extruder TARGET=220\nG4 P1000\nLOOK\nABORT\n"
    run = simulate(gcode, config=machine(tmp_path, LOOK))
    text = run.log.read_text()
    assert run.status == 0, run.stderr + text[-2000:]
    assert re.search(r"driven by model, unexplained -?[0-9.]+", text)
    assert "driven by calibration, unexplained None" in text


SHOW = """
[gcode_macro SHOW_POWER]
gcode:
  { action_respond_info("power %.4f" % printer.heater_bed.power) }
"""


def test_the_mcu_switches_a_bed_by_itself(simulate: Simulate, tmp_path: Path) -> None:
    """The true bed stays near its target, and the power the host reports is what the losses take."""
    more = LIGHT + "[heater_bed]\ncontrol: mcu_onoff\n" + SHOW
    gcode = "M190 S60\nG4 P60000\n" + "G4 P1000\nSHOW_POWER\n" * 40
    run = simulate(gcode, config=machine(tmp_path, more))
    assert run.status == 0, run.stderr
    held = run.column("bed_c")[-4000:]
    # 200 W into 100 J/K behind a sensor of 3 s: it swings by what goes in while the sensor lags
    assert all(abs(c - 60.0) < 6.0 for c in held)
    powers = [float(p) for p in re.findall(r"power ([0-9.]+)", run.log.read_text())]
    mean_c = sum(held) / len(held)
    true = (0.8 + 0.4) * (mean_c - 22.5) / 200.0  # both paths of loss, of 200 W
    assert sum(powers[-40:]) / 40 == pytest.approx(true, rel=0.15)  # 40 looks at an average over 10 s


def test_a_hotend_finds_heat_losses_and_fan_in_minutes(simulate: Simulate, tmp_path: Path) -> None:
    """Cartridge, block and thermistor of the simulated machine: 2 + 15 J/K, 70.5 mW/K, part fan 30 mW/K."""
    gcode = "MODEL_CALIBRATE HEATER=extruder TARGET=200 WAIT=1 POWER=40 FAN=1 FLOW=4\nM109 S210\nG4 P20000\n"
    run = simulate(gcode, config=MEGA)
    text = run.log.read_text()
    assert run.status == 0, run.stderr

    def found(name: str) -> float:
        match = re.search(rf"set \[extruder\] {name} = ([0-9.]+)", text)
        assert match is not None, text[-2000:]
        return float(match[1])

    assert found("model_heat_j_per_k") + found("model_element_j_per_k") == pytest.approx(17.0, rel=0.03)
    assert found("model_loss_w_per_k") == pytest.approx(0.0705, rel=0.03)
    assert found("model_fan_w_per_k") == pytest.approx(0.030, rel=0.10)
    minutes = run.column("t_s")[-1] / 60.0
    assert minutes < 8.0
    held = run.column("true_c")[-500:]
    assert all(abs(c - 210.0) < 1.0 for c in held)  # under the law it has just measured


def test_an_ended_run_leaves_the_heater_off_and_nothing_changed(simulate: Simulate, tmp_path: Path) -> None:
    gcode = "MODEL_CALIBRATE HEATER=extruder TARGET=200 POWER=40\nG4 P20000\nABORT\nG4 P2000\n"
    run = simulate(gcode, config=MEGA)
    text = run.log.read_text()
    assert run.status == 0, run.stderr
    assert (
        "MODEL_CALIBRATE ended: ended by ABORT. Nothing was changed." in text
        and "save_config: set" not in text
    )
    power = run.column("power_w")
    assert max(power) > 30.0 and max(power[-50:]) == 0.0


@pytest.mark.parametrize(("cutoff_c", "peak_c"), [(15, 277.2), (4, 266.0)])
def test_the_published_table_swings_a_strong_nozzle_and_the_cutoff_bounds_it(
    simulate: Simulate, tmp_path: Path, cutoff_c: int, peak_c: float
) -> None:
    more = f"[induction_heater nozzle]\ncontrol: two_period\npractical_cutoff: {cutoff_c}\n"
    more += "[simulator nozzle nozzle]\npreset: strong\n"
    run = simulate("M109 S250\nG4 P5000\nM104 S0\n", config=machine(tmp_path, more))
    assert run.status == 0, run.stderr  # M109 ended, no guard tripped
    # above the cutoff comes what the loop's delay adds: some 12 degC at 600 degC/s
    assert max(run.column("true_c")) == pytest.approx(peak_c, abs=3.0)
