"""NOZZLE_MONITOR_CALIBRATE in closed loop: it finds the mount of the simulated machine, and its law of the flow."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import pytest

from probe_rig import CONFIG, run
from simulation.runner import PRINTED

CLOG = CONFIG.with_name("sim-clog.cfg")
GCODE = "M104 S220\nG28\nG1 X90 Y90 Z60 F6000\nM109 S220\nNOZZLE_MONITOR_CALIBRATE\nG4 P2000\n"
REPORT = "NOZZLE_REPORT PLOT=1 NAME=a\n"


def test_the_mounts_frequency_and_flow_exponent_are_those_of_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    mount = [
        ("simulator mount nozzle", "frequency", "187"),
        ("simulator mount nozzle", "flow_exponent", "1.25"),
    ]
    result = run(tmp_path, GCODE + REPORT, *mount, config=CLOG)
    assert result.status == PRINTED, result.reason
    saved = result.object("configfile").get_status(0.0)["save_config_pending_items"]["nozzle_monitor"]
    assert float(saved["mount_frequency"]) == pytest.approx(187.0, abs=1.0)
    assert float(saved["mount_quality"]) == pytest.approx(20.0, rel=0.3)
    assert float(saved["flow_exponent"]) == pytest.approx(1.25, abs=0.15)
    assert re.search(r"The mount rings at 18\d\.\d Hz", result.text)
    sigma = re.search(r"flow exponent 1\.\d\d \+- (\d\.\d\d)", result.text)
    assert sigma is not None and 0.0 < float(sigma[1]) <= 0.03
    assert "TIME" not in result.text
    assert "Diameter: " in result.text
    rows = (tmp_path / "nozzle_report_a.csv").read_text().splitlines()
    assert rows[0] == "t_s,condition,diameter_mm,sigma_mm,lost_flow,evidence" and len(rows) > 10
    assert (tmp_path / "nozzle_report_a.png").read_bytes().startswith(b"\x89PNG")


def test_a_cold_nozzle_and_a_mount_without_vibration_are_refused(tmp_path: Path) -> None:
    cold = run(tmp_path, "G28\nNOZZLE_MONITOR_CALIBRATE\n", config=CLOG)
    assert "heat the nozzle first; it has 2" in cold.reason + cold.text
    same = run(tmp_path, GCODE.replace("CALIBRATE", "CALIBRATE FLOW=5,six"), config=CLOG)
    assert "FLOW must be flows in mm3/s, the greatest at least 1.5 times" in same.reason + same.text
    dead = run(tmp_path, GCODE, ("simulator mount nozzle", "amplitude", "0"), config=CLOG)
    assert "flow adds no vibration" in dead.reason + dead.text
