"""The benches that are studies, each in its small form: whole prints with the firmware's guard, limits met."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from system.conftest import ROOT

STUDIES = ROOT / "config" / "studies"
SMALL = sorted(path.stem for path in STUDIES.glob("*.toml") if "small" in tomllib.loads(path.read_text()))


@pytest.mark.parametrize("name", SMALL)
def test_a_bench_in_its_small_form_meets_its_limits(name: str, tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "study.py"), str(STUDIES / f"{name}.toml")]
    options = ["--small", "--workers", "1", "--out", str(tmp_path)]
    done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
