"""Tunings in printer.cfg that no heater can have: each is refused at once, with section, option, file and line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from system.conftest import Simulate, machine


def play(simulate: Simulate, tmp_path: Path, more: str) -> tuple[int, str]:
    run = simulate("G4 P100\n", config=machine(tmp_path, more))
    return run.status, run.stderr


def assert_reported_where(text: str, more: str, section: str, option: str) -> None:
    """The message names section and option, and the file and line in which a user finds the option (or the section)."""
    lines = ["[include]", *more.splitlines()]
    at = next((i for i, line in enumerate(lines, 1) if line.startswith(f"{option}:")), None)
    assert f"'{section}'" in text and option.lower() in text.lower(), text[-600:]
    assert at is not None and re.search(rf"printer\.cfg, line {at}[);]", text), text[-600:]


@pytest.mark.parametrize(
    ("section", "option", "value", "more"),
    [
        ("induction_heater nozzle", "pid_kp_w_per_k", "0", "control: pid\n"),
        ("induction_heater nozzle", "pid_kp_w_per_k", "nan", ""),
        ("induction_heater nozzle", "pid_ki_w_per_k_s", "-1", "control: pid\n"),
        ("induction_heater nozzle", "heat_capacity_j_per_k", "-0.4", ""),
        ("induction_heater nozzle", "heat_capacity_j_per_k", "1e-6", ""),  # a step would never end
        ("induction_heater nozzle", "heat_capacity_j_per_k", "1e6", ""),
        ("induction_heater nozzle", "loss_factor", "0", ""),
        ("induction_heater nozzle", "loss_w_per_k", "0", "loss_radiation_m2: 0\n"),
        ("induction_heater nozzle", "control", "magic", ""),
        ("heater_bed", "pid_Kp", "-1", ""),
        ("heater_bed", "pid_Ki", "inf", ""),
        ("heater_bed", "max_delta", "0", "control: watermark\n"),
        ("heater_bed", "max_delta", "200", "control: watermark\n"),  # it would not begin to heat
        ("induction_heater nozzle", "max_delta", "200", "control: watermark\n"),
        ("heater_bed", "two_period_turn", "0", "control: two_period\n"),
        ("heater_bed", "max_power", "0", ""),
        ("heater_bed", "model_hat", "3", ""),
        ("heater_profile heater_bed x", "pid_Kp", "-3", "control: pid\npid_Ki: 1\npid_Kd: 1\n"),
        ("heater_profile heater_bed x", "speed", "1", "control: watermark\n"),
        ("heater_profile extruder x", "pid_kp", "22", "control: pid\n"),  # an ordinary heater's
        ("heater_profile extruder x", "control", "mcu_onoff", ""),
        ("heater_profile extruder x", "heat_capacity_j_per_k", "1e9", "control: model\n"),
    ],
)
def test_an_impossible_tuning_is_refused_with_section_option_file_and_line(
    simulate: Simulate, tmp_path: Path, section: str, option: str, value: str, more: str
) -> None:
    written = f"[{section}]\n{more}{option}: {value}\n"
    status, text = play(simulate, tmp_path, written)
    assert status == 2
    assert_reported_where(text, written, section, option)


def test_a_profile_of_no_heater_is_reported_at_once(simulate: Simulate, tmp_path: Path) -> None:
    status, text = play(simulate, tmp_path, "[heater_profile oven x]\ncontrol: pid\n")
    assert status == 2
    assert "'heater_profile oven x': Unknown heater 'oven' (known: extruder, heater_bed)" in text
    assert "printer.cfg, line 2" in text


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
    status, text = play(simulate, tmp_path, BED_MODEL.format(**GOOD))
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
        ("model_heat_j_per_k", "1e-6"),
        ("model_heat_j_per_k", "1e12"),
        ("model_loss_w_per_k", "500"),
        ("model_sensor_lag", "1e-7"),
        ("model_sensor_lag", "-3"),
        ("model_ambient_temp", "-400"),
        ("heater_power_w", "much"),
    ],
)
def test_an_impossible_model_of_a_bed_is_refused_with_section_and_option(
    simulate: Simulate, tmp_path: Path, option: str, value: str
) -> None:
    written = BED_MODEL.format(**GOOD | {option: value})
    status, text = play(simulate, tmp_path, written)
    assert status == 2
    named = (
        option if option != "model_element_j_per_k" else "model_element_w_per_k"
    )  # the one without the other
    assert_reported_where(text, written, "heater_bed", named)
