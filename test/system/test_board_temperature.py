"""The temperature inside a board's chip, on the simulated printer."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from simulation.runner import PRINTED, RunOptions, Simulation
from system.conftest import CONFIG, TWO_MCUS, Simulate, machine

BOARD = """
[temperature_sensor board]
sensor_type: temperature_mcu
min_temp: 0
max_temp: 85
"""
CODE_C = 3.3 / 4095 / 0.0042  # a code of the converter: 0.19 K
WHERE = "simulator mcu", "chip_temperature"


def with_sensor(tmp_path: Path, base: Path = CONFIG, more: str = "") -> Path:
    return machine(tmp_path, BOARD + more, base)


def sent_c(config: Path, overrides: tuple[tuple[str, str, str], ...] = ()) -> float:
    """What the printer's status says of the board after two seconds."""
    part = config.with_name("part.gcode")
    part.write_text("G4 P2000\n")
    run = Simulation(RunOptions(config, part, overrides=overrides))
    outcome = run.run()
    assert outcome.status == PRINTED, outcome.reason
    status = run.printer.lookup_object("temperature_sensor board").get_status(0.0)
    assert status["measured_min_temp"] <= status["temperature"] <= status["measured_max_temp"]
    return float(status["temperature"])


@pytest.mark.parametrize(("overrides", "temp_c"), [((), 40.0), (((*WHERE, "71.5"),), 71.5)])
def test_a_chip_reports_its_temperature(
    tmp_path: Path, overrides: tuple[tuple[str, str, str], ...], temp_c: float
) -> None:
    # the status has two decimals
    assert sent_c(with_sensor(tmp_path), overrides) == pytest.approx(temp_c, abs=0.5 * CODE_C + 0.005)


def test_each_board_has_a_temperature_of_its_own(tmp_path: Path) -> None:
    heater = "sensor_mcu: heater\n\n[simulator mcu heater]\nchip_temperature: 12\n"
    config = with_sensor(tmp_path, TWO_MCUS, heater)
    assert sent_c(config) == pytest.approx(12.0, abs=0.5 * CODE_C + 0.005)


def test_a_chip_too_hot_ends_the_print_by_its_sensors_name(simulate: Simulate, tmp_path: Path) -> None:
    run = simulate("G4 P5000\n", config=with_sensor(tmp_path), settings=["simulator mcu.chip_temperature=93"])
    assert run.status == 3, run.stderr
    reason = run.summary["reason"]
    assert re.search(r"board: 9[23]\.\d C; allowed are 0 to 85 C", reason), reason


def test_a_chip_that_cannot_be_so_hot_is_refused(simulate: Simulate, tmp_path: Path) -> None:
    run = simulate("", config=with_sensor(tmp_path), settings=["simulator mcu.chip_temperature=500"])
    assert run.status == 2 and "chip_temperature" in run.stderr
