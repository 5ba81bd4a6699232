"""Third-party style modules, written against the promised surface, load and work unchanged."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from simulation import world as world_module

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(__file__).resolve().parent / "folder"

SECTIONS = """
[sine_sensor]
[temperature_sensor chamber]
sensor_type: SINE
min_temp: 0
max_temp: 100
sine_mean: 45
[greeter polite]
delay: 0.01
gcode: M118 hello {who} at {printer.toolhead.position.z}
[homing_watch]
lift: 3
[plain_function]
factor: 3
mode: sub
[respond]
"""
SCRIPT = """
G28
HOMING_WATCH
GREET GREETER=polite WHO=world TIMES=2
PLAIN VALUE=1.5
"""


def run_host(tmp_path: Path, klippy: Path, config: str, script: str) -> tuple[int, str]:
    """The host in batch mode on the simulated printer's config; exit status and its messages to the user."""
    world_module.build()
    (tmp_path / "printer.cfg").write_text(config)
    (tmp_path / "in.gcode").write_text(script)
    done = subprocess.run(
        [sys.executable, klippy / "klippy.py", tmp_path / "printer.cfg", "-i", tmp_path / "in.gcode",
         "-o", tmp_path / "out", "-d", world_module.MCU_DICTIONARY, "-l", tmp_path / "log"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    return done.returncode, (tmp_path / "log").read_text() + done.stderr


def printer_cfg(extra: str) -> str:
    return f"{extra}\n[include {ROOT}/config/sim-induction.cfg]\n"


def check(status: int, log: str) -> None:
    assert status == 0, log[-3000:]
    assert "homed now: xyz" in log
    assert "rails [['stepper_x'], ['stepper_y'], ['stepper_z']] axes [0, 1, 2]" in log
    assert "z 3.000" in log
    assert "plain -4.5 clock ok" in log
    assert "Traceback" not in log


def test_plugins_of_a_configured_folder(tmp_path: Path) -> None:
    config = printer_cfg(f"[plugins]\npath: {FOLDER}\n{SECTIONS}")
    check(*run_host(tmp_path, ROOT / "klippy", config, SCRIPT))


def test_plugins_dropped_into_extras(tmp_path: Path) -> None:
    klippy = tmp_path / "tree" / "klippy"
    shutil.copytree(ROOT / "klippy", klippy, ignore=shutil.ignore_patterns("__pycache__"))
    os.symlink(ROOT / "out", tmp_path / "tree" / "out")
    os.symlink(ROOT / "src", tmp_path / "tree" / "src")
    os.symlink(ROOT / "VERSION", tmp_path / "tree" / "VERSION")
    shutil.copytree(FOLDER, klippy / "extras", dirs_exist_ok=True)
    check(*run_host(tmp_path, klippy, printer_cfg(SECTIONS), SCRIPT))


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("GREET GREETER=polite", "GREET needs somebody"),
        ("GREET GREETER=rude WHO=me", "not valid for GREETER"),
    ],
)
def test_a_plugin_refuses_like_any_command(tmp_path: Path, script: str, words: str) -> None:
    config = printer_cfg(f"[plugins]\npath: {FOLDER}\n{SECTIONS}")
    status, log = run_host(tmp_path, ROOT / "klippy", config, script)
    assert status == 255
    assert words in log


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({}, "unable to read the folder"),
        ({"broken.py": "import nothing_of_that_name\n"}, "Plugin 'broken'"),
        ({"fan.py": ""}, "has the name of a module of this program"),
    ],
)
def test_a_folder_that_cannot_be_used_is_explained(tmp_path: Path, files: dict[str, str], words: str) -> None:
    folder = tmp_path / "plugins"
    if files:
        folder.mkdir()
    for name, text in files.items():
        (folder / name).write_text(text)
    config = printer_cfg(f"[plugins]\npath: {folder}\n[broken]\n")
    status, log = run_host(tmp_path, ROOT / "klippy", config, "")
    assert status == 255
    assert words in log


USER = """
def load_config(config):
    printer = config.get_printer()
    helper = printer.load_object(config, "helper_tool")
    named = printer.load_object(config, "helper_tool big")
    printer.lookup_object("gcode").respond_info(f"helpers {helper} {named}")
    return helper
"""
HELPER = """
def load_config(config):
    return "plain"


def load_config_prefix(config):
    return config.get_name() + " " + config.get("size")
"""
FREE_RAIL = """
import stepper


class NoEndstop:
    def add_stepper(self, *args, **kwargs):
        pass


class FreeRail(stepper.PrinterRail, object):
    def __init__(self, config, **kwargs):
        self.added = []
        super(FreeRail, self).__init__(config, **kwargs)

    def add_extra_stepper(self, config, **kwargs):
        if not self.endstops and config.get("endstop_pin", None) is None:
            self.endstops = [(NoEndstop(), "none")]
        super(FreeRail, self).add_extra_stepper(config, **kwargs)
        self.added.append(config.get_name())


def load_config_prefix(config):
    rail = FreeRail(config, need_position_minmax=False, default_position_endstop=0.0)
    if config.has_section("gear_motor"):
        rail.add_extra_stepper(config.getsection("gear_motor"))
    names = [stepper.get_name() for stepper in rail.get_steppers()]
    endstops = [name for endstop, name in rail.get_endstops()]
    config.get_printer().lookup_object("gcode").respond_info(f"rail {rail.added} {names} {endstops}")
    return rail
"""


def with_plugins(tmp_path: Path, files: dict[str, str], sections: str) -> str:
    """A config with these files as plugins; [plugins] is its last section."""
    (tmp_path / "own").mkdir()
    for name, text in files.items():
        (tmp_path / "own" / name).write_text(text)
    return f"[include {ROOT}/config/sim-induction.cfg]\n{sections}\n[plugins]\npath: {tmp_path / 'own'}\n"


def test_a_plugin_loads_another_one_of_its_folder(tmp_path: Path) -> None:
    sections = "[user]\n[helper_tool big]\nsize: 3\n"
    config = with_plugins(tmp_path, {"user.py": USER, "helper_tool.py": HELPER}, sections)
    status, log = run_host(tmp_path, ROOT / "klippy", config, "")
    assert status == 0, log[-3000:]
    assert "helpers plain helper_tool big 3" in log


def test_sections_of_plugins_are_loaded_in_the_order_of_the_config(tmp_path: Path) -> None:
    """As if the file were in klippy/extras: the sensor type is known where it is used, before [plugins]."""
    sensor = (FOLDER / "sine_sensor.py").read_text()
    sections = "[sine_sensor]\n[temperature_sensor chamber]\nsensor_type: SINE\nmin_temp: 0\nmax_temp: 100\n"
    config = with_plugins(tmp_path, {"sine_sensor.py": sensor}, sections)
    status, log = run_host(tmp_path, ROOT / "klippy", config, "")
    assert status == 0, log[-3000:]


def stepper_section(name: str, first_pin: int, more: str = "") -> str:
    pins = f"step_pin: PC{first_pin}\ndir_pin: PC{first_pin + 1}\n"
    return f"[{name}]\n{pins}microsteps: 16\nrotation_distance: 40\n{more}"


def test_a_plugin_derives_from_the_rail(tmp_path: Path) -> None:
    """Its add_extra_stepper is called for the rail's own section, too, and may do without an endstop_pin."""
    sections = stepper_section("free_rail gear", 5) + stepper_section("gear_motor", 7)
    config = with_plugins(tmp_path, {"free_rail.py": FREE_RAIL}, sections)
    status, log = run_host(tmp_path, ROOT / "klippy", config, "QUERY_ENDSTOPS")
    assert status == 0, log[-3000:]
    assert "rail ['free_rail gear', 'gear_motor'] ['free_rail gear', 'gear_motor'] ['none']" in log


def test_a_rail_of_a_plugin_has_the_endstop_of_its_section(tmp_path: Path) -> None:
    endstop = "endstop_pin: ^PC7\nposition_endstop: 0\n"
    config = with_plugins(
        tmp_path, {"free_rail.py": FREE_RAIL}, stepper_section("free_rail selector", 5, endstop)
    )
    status, log = run_host(tmp_path, ROOT / "klippy", config, "QUERY_ENDSTOPS")
    assert status == 0, log[-3000:]
    assert "rail ['free_rail selector'] ['free_rail selector'] ['free_rail selector']" in log
