"""Plugins that move motors, probe and change the config by themselves, from a folder and dropped into extras."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from plugins.test_plugins import ROOT, run_host

MACHINES = Path(__file__).resolve().parent / "machines"
CONFIG = """
[panel]
[include {root}/config/example-cartesian.cfg]
[respond]
[rack]
[stepper_x]
step_pulse_duration: 0.000003
[stepper_selector]
step_pin: PD0
dir_pin: PD1
enable_pin: !PD2
microsteps: 16
rotation_distance: 40
endstop_pin: PD3
position_endstop: 0
position_max: 100
[stepper_drive]
step_pin: PD4
dir_pin: PD5
enable_pin: !PD6
microsteps: 16
rotation_distance: 20
endstop_pin: PD7
position_endstop: 0
position_max: 10000
[shuttle lift]
step_pin: PE0
dir_pin: PE1
enable_pin: !PE2
microsteps: 16
rotation_distance: 8
endstop_pin: PE3
position_endstop: 0
position_max: 60
[tool_tap]
samples: 3
sample_retract_dist: 1.5
switches: tap 0
[tap 0]
pin: PE4
z_offset: 0.75
x_offset: 3
"""
SCRIPT = """
PANEL
RACK_HOME
RACK_MOVE SELECTOR=30 DRIVE=12
RACK_SYNC
RACK_MOVE DRIVE=20
RACK_UNSYNC
RACK_MOVE DRIVE=25
G28
G1 X20 Y20 Z5 F6000
RACK_MOVE SELECTOR=60
G1 X40 F6000
SHUTTLE RAIL=lift HOME=1
SHUTTLE RAIL=lift MOVE=15
SHUTTLE RAIL=lift GCODE_AXIS=A
G1 X50 A25 F3000
G1 A10 F3000
SHUTTLE RAIL=lift GCODE_AXIS=
PROBE
PROBE_ACCURACY SAMPLES=2
PROBE_CALIBRATE
TESTZ Z=-1
ACCEPT
PANEL_CLEAN WHAT=wiper
"""


def drop_into_extras(tmp_path: Path) -> Path:
    """A copy of the host with the plugins among its own modules."""
    klippy = tmp_path / "tree" / "klippy"
    shutil.copytree(ROOT / "klippy", klippy, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("out", "src", "VERSION"):
        os.symlink(ROOT / name, tmp_path / "tree" / name)
    shutil.copytree(MACHINES, klippy / "extras", dirs_exist_ok=True)
    return klippy


@pytest.mark.parametrize("dropped", [False, True], ids=["folder", "extras"])
def test_plugins_with_machines_of_their_own(tmp_path: Path, dropped: bool) -> None:
    folder = "" if dropped else f"[plugins]\npath: {MACHINES}\n"
    klippy = drop_into_extras(tmp_path) if dropped else ROOT / "klippy"
    status, log = run_host(tmp_path, klippy, folder + CONFIG.format(root=ROOT), SCRIPT)
    assert status == 0, log[-3000:]
    assert "Traceback" not in log
    assert "panel of Ferrite ['0.000003', '0.000003', '0.000003']" in log
    assert "accel 3000 1500 3000 corner 4" in log
    assert "clean wiper, probed 0.00" in log
    # selector, drive, extruder: the extruder's motor turns with the drive while they are joined
    assert "rack homed ['stepper_selector']: 0.00 0.00 0.00 idle True" in log
    assert "rack moved: 30.00 12.00 0.00 idle True" in log
    assert "rack moved: 30.00 20.00 20.00 idle True" in log
    assert "rack moved: 30.00 25.00 0.00 idle True" in log
    assert "rack moved: 60.00 25.00 0.00 idle True" in log
    assert "shuttle at 0.000 motor 0.00 flushed True" in log
    assert "shuttle at 15.000 motor 15.00" in log
    assert "shuttle at 10.000 motor 10.00" in log
    assert log.count("probe at 50.000,20.000 is z=0.000000") == 3 + 2 + 3
    assert "Result is z=0.000000" in log and "standard deviation 0.000000" in log
    assert "tool_tap: z_offset: -4.000" in log
