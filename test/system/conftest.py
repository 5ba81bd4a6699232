"""Simulated prints for tests: scripts/simulate.py as a user runs it, on small files."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from simulation import world as world_module

ROOT = Path(__file__).resolve().parent.parent.parent
CONFIG = ROOT / "config" / "sim-induction.cfg"
TWO_MCUS = ROOT / "config" / "sim-two-mcu.cfg"

# A 20 mm square at print speed: 0.4 x 0.2 mm lines at 60 mm/s are 4.8 mm3/s.
SQUARE = """
M104 S250
G28
G90
M83
G1 X60 Y60 Z0.3 F6000
M109 S250
{body}
G1 E-1 F2400
M400
M104 S0
"""
LINE_E = 20.0 * 0.4 * 0.2 / 2.405  # filament for 20 mm of a 0.4 x 0.2 mm line, mm


def square(rounds: int = 2, feed: int = 3600) -> str:
    """G-code: heat to 250 °C, home, go round a 20 mm square."""
    corners = ((80, 60), (80, 80), (60, 80), (60, 60))
    body = [f"G1 X{x} Y{y} E{LINE_E:.5f} F{feed}" for _ in range(rounds) for x, y in corners]
    return SQUARE.format(body="\n".join(body))


@dataclass(frozen=True)
class Run:
    """What one run of simulate.py left."""

    status: int
    stdout: str
    stderr: str
    summary: dict[str, Any]
    trace: Path
    log: Path  # the host's

    def column(self, name: str) -> list[float]:
        """One column of the trace."""
        with self.trace.open(newline="") as f:
            return [float(row[name]) for row in csv.DictReader(f)]


Simulate = Callable[..., Run]


def machine(folder: Path, more: str = "", base: Path = CONFIG) -> Path:
    """printer.cfg of `base` and what `more` adds to it or says otherwise."""
    path = folder / "printer.cfg"
    path.write_text(f"[include {base}]\n{more}\n")
    return path


@pytest.fixture(scope="session", autouse=True)
def built() -> None:
    """The simulator is up to date before the first run."""
    world_module.build()


@pytest.fixture
def simulate(tmp_path: Path) -> Simulate:
    """Run simulate.py: simulate(gcode_text, config=..., seed=..., settings=[...], more=[...])."""
    count = 0

    def run(
        gcode: str | Path,
        config: Path = CONFIG,
        seed: int = 1,
        settings: Sequence[str] = (),
        more: Sequence[str] = (),
    ) -> Run:
        nonlocal count
        count += 1
        folder = tmp_path / str(count)
        folder.mkdir()
        path = gcode
        if isinstance(gcode, str):
            path = folder / "part.gcode"
            path.write_text(gcode)
        summary, trace, log = folder / "summary.json", folder / "trace.csv", folder / "host.log"
        command = [sys.executable, ROOT / "scripts" / "simulate.py", config, path, "--seed", str(seed)]
        command += ["--summary", summary, "--trace", trace, "--log", log, *more]
        for setting in settings:
            command += ["--set", setting]
        done = subprocess.run(
            list(map(str, command)), capture_output=True, text=True, timeout=300, check=False
        )
        facts = json.loads(summary.read_text()) if summary.exists() else {}
        return Run(done.returncode, done.stdout, done.stderr, facts, trace, log)

    return run
