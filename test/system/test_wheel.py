"""What `pip install .` brings: programs that need no checkout."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SETUP = tomllib.loads((ROOT / "pyproject.toml").read_text())
PRINT = "M104 S100\nG28\nM109 S100\nG1 X10 Y10 Z5 F6000\nM104 S0\n"


def tracked(*folders: str) -> list[Path]:
    """Files of the project, new ones included, without what is built."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *folders]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    return [Path(name) for name in names if name and (ROOT / name).is_file()]


def run(*command: object, cwd: Path) -> str:
    """Output of a program that sees nothing of this tree's environment."""
    environment = {"PATH": os.defpath, "HOME": str(cwd)}
    done = subprocess.run(
        [str(word) for word in command], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def build_wheel(folder: Path) -> Path:
    """From a copy: setuptools leaves a build folder in the tree."""
    for path in tracked():
        (folder / "tree" / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / path, folder / "tree" / path)
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    run(sys.executable, "-m", "pip", "wheel", *options, "-w", folder, folder / "tree", cwd=folder)
    (wheel,) = folder.glob("*.whl")
    return wheel


def install(wheel: Path, folder: Path) -> Path:
    """Into an environment of its own that sees the packages of this one; its programs' folder."""
    venv.create(folder, symlinks=True)
    programs = folder / "bin"
    packages = Path(sysconfig.get_path("purelib", "venv", {"base": str(folder)}), "dependencies.pth")
    packages.write_text("\n".join(path for path in sys.path if path.endswith("-packages")))
    options = ["--no-deps", "--no-index", "--disable-pip-version-check"]
    python = programs / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", *options, wheel, cwd=folder)
    return programs


def test_every_folder_with_modules_is_a_package_of_the_wheel() -> None:
    folders = {path.parent for path in tracked("klippy", "scripts") if path.suffix == ".py"}
    folders = {path for path in folders if path.parts[:2] not in (("scripts", "bench"), ("scripts", "check"))}
    expected = {"ferrite", *(".".join(("ferrite", *path.parts)) for path in folders)}
    assert set(SETUP["tool"]["setuptools"]["packages"]) == expected


@pytest.mark.slow
def test_wheel_prints_on_the_simulated_printer(tmp_path: Path) -> None:
    wheel = build_wheel(tmp_path)
    carried = {name.removeprefix("ferrite/") for name in zipfile.ZipFile(wheel).namelist()}
    needed = {
        str(path)
        for path in tracked("klippy", "src", "config", "scripts", "Makefile")
        if path.suffix != ".md" and path.parts[:2] not in (("scripts", "bench"), ("scripts", "check"))
    }
    assert needed - carried == set()

    programs = install(wheel, tmp_path / "environment")
    for name in SETUP["project"]["scripts"]:
        assert "usage: " in run(programs / name, "--help", cwd=tmp_path)

    (config,) = (tmp_path / "environment").rglob("ferrite/config/sim-induction.cfg")
    (tmp_path / "part.gcode").write_text(PRINT)
    results = ["--summary", "summary.json", "--report", "report.html", "--quiet"]
    run(programs / "ferrite-simulate", config, "part.gcode", *results, cwd=tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["status"] == "printed" and summary["faults"] == []
    assert summary["axes"]["x"]["position_mm"] > 9.9
    assert (tmp_path / "report.html").stat().st_size > 10_000
