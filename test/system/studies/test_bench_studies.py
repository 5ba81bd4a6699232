"""The benches that are studies, each in its small form: whole prints with the firmware's guard, limits met."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from system.conftest import ROOT

STUDIES = ROOT / "config" / "studies"
SMALL = {path.stem for path in STUDIES.glob("*.toml") if "small" in tomllib.loads(path.read_text())}
AHEAD = {"bench_machines", "disturbance"}  # its limits are for a printer that is better than this one


def run_small(name: str, out: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "scripts" / "study.py"), str(STUDIES / f"{name}.toml")]
    options = ["--small", "--workers", "1", "--out", str(out)]
    return subprocess.run([*command, *options], capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.parametrize("name", sorted(SMALL - AHEAD))
def test_a_bench_in_its_small_form_meets_its_limits(name: str, tmp_path: Path) -> None:
    done = run_small(name, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_machines_are_drawn_calibrated_and_printed_on_whatever_becomes_of_them(tmp_path: Path) -> None:
    """Each machine with each set of sensors; a print that trips is a row, and a limit that is not met is shown."""
    done = run_small("bench_machines", tmp_path)
    assert done.returncode in (0, 1), done.stderr
    rows = pq.read_table(tmp_path / "results.parquet").to_pylist()
    machines = {row["simulator nozzle nozzle.machine_number"] for row in rows}
    assert len(machines) == 2
    assert sorted(row["variant"] for row in rows) == ["none", "none", "vdc", "vdc"]
    assert {row["status"] for row in rows} <= {
        "printed",
        "printer shut down",
        "calibration failed",
        "bad input",
    }
    for row in rows:
        tank = [row[f"simulator nozzle nozzle.{part}"] for part in ("c1_uf", "l1_uh")]
        assert tank[0] * tank[1] == pytest.approx(0.7351 * 3.6, rel=1e-6)  # along the tuned line
        assert row["simulator nozzle nozzle.supply_v"].startswith(f"0:{row['volt']:.9g}, 300:")
    assert ("NOT MET" in done.stdout) == (done.returncode == 1)
    assert "over_first_c" in (tmp_path / "index.html").read_text()
