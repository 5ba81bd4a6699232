"""Machines whose motors do not each move one axis, in closed loop: they home against switches of a simulated frame."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from simulation.runner import PRINTED, RunOptions, Simulation

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "config" / "sim-induction.cfg"

GCODE = "G28\nG1 X50 Y60 Z5 F6000\nG1 X20 Y90\nG28 Y\nG1 X70 Y40 Z8\nM400\n"

ARM_MM, RADIUS_MM, TOP_MM = 217.0, 100.0, 150.0
DELTA = f"""[mcu]
serial: /tmp/ferrite_mcu
restart_method: command
[virtual_sdcard]
path: .
[printer]
kinematics: delta
max_velocity: 200
max_accel: 3000
max_z_velocity: 100
minimum_z_position: -1
delta_radius: {RADIUS_MM}
"""
TOWER = """[stepper_{name}]
step_pin: P{port}1
dir_pin: P{port}2
enable_pin: !P{port}3
endstop_pin: P{port}4
microsteps: 16
rotation_distance: 40
homing_speed: 50
[simulator axis {name}]
start_position: {start}
"""


def finish(config: Path, tmp_path: Path, gcode: str, *overrides: tuple[str, str, str]) -> dict[str, Any]:
    path = tmp_path / "part.gcode"
    path.write_text(gcode)
    outcome = Simulation(RunOptions(config, path, 1, overrides)).run()
    assert outcome.status == PRINTED, outcome.reason
    axes: dict[str, Any] = outcome.summary["axes"]
    return axes


@pytest.mark.parametrize("kinematics", ["corexy", "corexz", "hybrid_corexy", "hybrid_corexz"])
def test_a_core_machine_homes_and_goes_where_it_is_reported(kinematics: str, tmp_path: Path) -> None:
    axes = finish(CONFIG, tmp_path, GCODE, ("printer", "kinematics", kinematics))
    # a step of a belt that both motors share is 0.0125 mm; z of a corexz is homed to a step of its own, too
    assert axes["x"]["position_mm"] == pytest.approx(70.0, abs=0.03)
    assert axes["y"]["position_mm"] == pytest.approx(40.0, abs=0.03)
    assert axes["z"]["position_mm"] == pytest.approx(8.0, abs=0.03)
    assert not any(axis["steps_lost"] for axis in axes.values())


def test_the_wrong_frame_is_noticed(tmp_path: Path) -> None:
    """A cartesian host on a corexy machine does not get where it thinks it is."""
    config = tmp_path / "printer.cfg"
    config.write_text(CONFIG.read_text())
    path = tmp_path / "part.gcode"
    path.write_text("G28 X\nG1 X50 F6000\nM400\n")
    simulation = Simulation(RunOptions(config, path, 1, ()))
    build = simulation._build_machine

    def build_coupled() -> Any:
        machine = build()
        machine.world.couple_axes(machine.axes["x"], machine.axes["y"], 0.5, 0.5)
        return machine

    simulation._build_machine = build_coupled  # type: ignore[method-assign]
    outcome = simulation.run()
    assert outcome.summary["axes"]["x"]["position_mm"] == pytest.approx(25.0, abs=1.0)


def test_a_delta_homes_its_towers(tmp_path: Path) -> None:
    config = tmp_path / "delta.cfg"
    starts = {"a": ("A", 60.0), "b": ("B", 75.0), "c": ("C", 68.0)}
    text = DELTA + "".join(TOWER.format(name=n, port=p, start=s) for n, (p, s) in starts.items())
    text = text.replace("[stepper_a]\n", f"[stepper_a]\nposition_endstop: {TOP_MM}\narm_length: {ARM_MM}\n")
    config.write_text(text)
    axes = finish(config, tmp_path, "G28\nG1 X20 Y30 Z50 F6000\nM400\n")
    for name, degrees in (("a", 210.0), ("b", 330.0), ("c", 90.0)):
        tower = RADIUS_MM * math.cos(math.radians(degrees)), RADIUS_MM * math.sin(math.radians(degrees))
        height = 50.0 + math.sqrt(ARM_MM**2 - (20.0 - tower[0]) ** 2 - (30.0 - tower[1]) ** 2)
        home = TOP_MM + math.sqrt(ARM_MM**2 - RADIUS_MM**2)
        below_switch = axes[name]["position_mm"] - TOP_MM
        assert below_switch == pytest.approx(height - home, abs=0.03)
        assert axes[name]["steps_lost"] == 0
