"""Who has installed a list of packages can run what it is for."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PACKAGES = importlib.metadata.packages_distributions()
OWN = {path.stem for folder in ("klippy", "scripts", "test") for path in (ROOT / folder).rglob("*.py")}
OWN |= {path.name for path in (ROOT / "klippy").iterdir()}


def pinned(name: str) -> set[str]:
    """Packages of a list and of those it includes, in small letters."""
    found = set()
    for line in (ROOT / name).read_text().splitlines():
        if line.startswith("-r "):
            found |= pinned(line[3:])
        elif line and not line.startswith("#"):
            found.add(re.split("==", line)[0].lower())
    return found


def needed(path: Path) -> Iterator[str]:
    """Packages a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or ""]
        for name in (full.partition(".")[0] for full in names):
            if name not in sys.stdlib_module_names and name not in OWN:
                yield PACKAGES[name][0].lower()


HOST = [p for p in (ROOT / "klippy").rglob("*.py") if "simulation" not in p.parts]
STUDY = [*(ROOT / "klippy" / "simulation" / "study").rglob("*.py"), ROOT / "scripts" / "study.py"]
SIMULATION = [p for p in (ROOT / "klippy" / "simulation").rglob("*.py") if p not in STUDY]
PROGRAMS = [*SIMULATION, *(p for p in (ROOT / "scripts").glob("*.py") if p not in STUDY)]


@pytest.mark.parametrize(
    ("files", "known"),
    [
        # the swarm is an offline tool's
        ([p for p in HOST if p.name != "fit_thermistor.py"], "requirements.txt"),
        ([*HOST, *PROGRAMS], "requirements-sim.txt"),
        ([*HOST, *PROGRAMS, *STUDY], "requirements-study.txt"),
    ],
)
def test_all_that_is_imported_is_on_the_list(files: list[Path], known: str) -> None:
    lacking = {f"{path.relative_to(ROOT)}: {name}" for path in files for name in needed(path)} - {
        f"{path.relative_to(ROOT)}: {name}" for path in files for name in pinned(known)
    }
    assert not lacking
    assert len(files) > 100


@pytest.mark.parametrize(
    ("files", "extras"),
    [
        ([p for p in HOST if p.name != "fit_thermistor.py"], []),
        ([*SIMULATION, ROOT / "scripts" / "simulate.py"], ["simulation"]),
        ([*SIMULATION, *STUDY], ["simulation", "study"]),
        ([ROOT / "scripts" / "console.py"], ["console"]),
    ],
    ids=["host", "simulation", "study", "console"],
)
def test_what_pip_installs_brings_what_its_programs_import(files: list[Path], extras: list[str]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = project["dependencies"] + [
        name for extra in extras for name in project["optional-dependencies"][extra]
    ]
    assert {name for path in files for name in needed(path)} <= {name.lower() for name in asked}


def test_a_program_names_the_package_it_lacks(tmp_path: Path) -> None:
    for name in ("in_venv.py", "plan_temperature.py"):
        (tmp_path / "scripts").mkdir(exist_ok=True)
        shutil.copy(ROOT / "scripts" / name, tmp_path / "scripts")
    program = [
        sys.executable,
        "-S",
        tmp_path / "scripts" / "plan_temperature.py",
        "--help",
    ]  # -S: no packages
    done = subprocess.run(list(map(str, program)), capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "Python package 'rich' is missing; `make setup` installs it" in done.stderr
