"""Firmware that lacks what a section needs is refused with a text that says so (batch mode, cut-down dictionary)."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from bus_rig import ROOT, build_dictionary

CONFIG = "[mcu]\nserial: x\n[printer]\nkinematics: none\nmax_velocity: 100\nmax_accel: 100\n"
SPI = "[temperature_sensor s]\nsensor_type: MAX6675\nsensor_pin: PA1\n"
SOFTWARE = "spi_software_sclk_pin: PA2\nspi_software_mosi_pin: PA3\nspi_software_miso_pin: PA4\n"
BUTTON = "[gcode_button b]\npin: PA5\npress_gcode: M117 x\n"


def batch(
    tmp_path: Path, sections: str, without: str | None, gcode: str = ""
) -> subprocess.CompletedProcess[str]:
    """The host writing to a file, for firmware without the command named."""
    tables = json.loads(build_dictionary())
    tables["commands"] = {k: v for k, v in tables["commands"].items() if k.split()[0] != without}
    (tmp_path / "dict").write_text(json.dumps(tables))
    (tmp_path / "printer.cfg").write_text(CONFIG + sections)
    (tmp_path / "in.gcode").write_text(gcode)
    command = [
        sys.executable,
        ROOT / "klippy" / "klippy.py",
        tmp_path / "printer.cfg",
        "-i",
        tmp_path / "in.gcode",
    ]
    command += ["-o", tmp_path / "out", "-d", tmp_path / "dict", "-l", tmp_path / "log"]
    return subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize(
    ("sections", "without"),
    [
        (SPI, "config_spi"),
        (SPI, "spi_set_bus"),
        (SPI, "config_thermocouple"),
        (SPI + SOFTWARE, "spi_set_sw_bus"),
        (BUTTON, "config_buttons"),
        (BUTTON, "buttons_ack"),
        ("[neopixel n]\npin: PA1\n", "neopixel_send"),
        ("[fan_generic f]\npin: PA1\ntachometer_pin: PA2\n", "config_counter"),
    ],
)
def test_the_missing_command_and_the_board_are_named(tmp_path: Path, sections: str, without: str) -> None:
    answer = batch(tmp_path, sections, without)
    assert answer.returncode == 255, answer.stderr
    assert f"'{without}'" in answer.stderr and "[mcu]" in answer.stderr
    assert "Traceback" not in answer.stderr + (tmp_path / "log").read_text()


EVERYTHING = (
    SPI
    + BUTTON
    + """
[neopixel n]
pin: PB1
chain_count: 3
[led l]
red_pin: PB2
[servo v]
pin: PB3
[pwm_cycle_time c]
pin: PB4
[fan_generic f]
pin: PB5
tachometer_pin: PB6
[temperature_sensor h]
sensor_type: temperature_host
sensor_path: /nowhere
[temperature_sensor both]
sensor_type: temperature_combined
sensor_list: temperature_sensor s, temperature_sensor h
combination_method: mean
maximum_deviation: 5
[pause_resume]
[filament_switch_sensor r]
switch_pin: PB7
"""
)
SCRIPT = """
SET_LED LED=n RED=1
SET_LED LED=l RED=1
SET_SERVO SERVO=v ANGLE=10
SET_PIN PIN=c VALUE=0.5 CYCLE_TIME=0.02
SET_FAN_SPEED FAN=f SPEED=0.5
QUERY_BUTTON BUTTON=b
QUERY_FILAMENT_SENSOR SENSOR=r
QUERY_ADC
G4 P2000
"""


def test_everything_together_runs_in_batch_mode(tmp_path: Path) -> None:
    answer = batch(tmp_path, EVERYTHING, None, SCRIPT)
    assert answer.returncode == 0, answer.stderr
    assert "Traceback" not in (tmp_path / "log").read_text()
    assert (tmp_path / "out").stat().st_size > 200
