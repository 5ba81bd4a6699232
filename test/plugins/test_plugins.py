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
    """The host in batch mode on the simulated printer's config; exit status and what it told the user."""
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
