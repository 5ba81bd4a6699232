"""Dry runs, die swell from measured strands, ooze pushed back: commands of [dry_run] and [extrusion]."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from system.conftest import CONFIG, Simulate, square
from thermal.extrusion import DieSwell, exit_diameter


def config(folder: Path, more: str) -> Path:
    path = folder / "printer.cfg"
    path.write_text(f"[include {CONFIG}]\n{more}")
    return path


def test_a_dry_run_follows_the_path_above_it_without_heat_or_filament(
    simulate: Simulate, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    gcode = (
        "G28\nG1 Z5 F600\nDRY_RUN ENABLE=1 Z_OFFSET=8\n"
        + square(1).replace("G28\n", "")
        + "DRY_RUN ENABLE=0\nG1 Z3\nM400\n"
    )
    run = simulate(gcode, config=config(tmp_path, "[dry_run]\n"), more=["--log", str(log)])
    assert run.status == 0, run.stderr
    x, z, e = (np.array(run.column(name)) for name in ("x_mm", "z_mm", "e_mm"))
    path = (x > 59.0) & (x < 81.0) & (z > 7.0)
    assert path.sum() > 100 and np.median(z[path]) == pytest.approx(
        8.3, abs=0.02
    )  # the square's Z0.3, lifted
    assert np.ptp(e) < 0.01
    assert max(run.column("power_w")) < 2.0 and max(run.column("target_c")) == 0.0
    assert z[-1] == pytest.approx(3.0, abs=0.02)  # as before
    left_out = re.search(r"(\d+) heating commands left out", log.read_text())
    assert left_out is not None and int(left_out[1]) == 3  # M104, M109, M104


def test_a_second_dry_run_and_an_end_without_one_are_refused(simulate: Simulate, tmp_path: Path) -> None:
    for lines, words in (
        ("DRY_RUN ENABLE=0\n", "none is under way"),
        ("DRY_RUN ENABLE=1\nDRY_RUN ENABLE=1\n", "under way already"),
        ("DRY_RUN Z_OFFSET=-1 ENABLE=1\n", "Z_OFFSET"),
    ):
        log = tmp_path / "log"
        simulate(lines, config=config(tmp_path, "[dry_run]\n"), more=["--log", str(log)])
        assert words in log.read_text()


def test_die_swell_is_fitted_from_measured_strands(simulate: Simulate, tmp_path: Path) -> None:
    truth = DieSwell(0.42, 0.0035)
    speeds = (0.5, 1.0, 2.0, 4.0)
    widths = ",".join(f"{exit_diameter(truth, v, 1.75):.4f}" for v in speeds)
    log = tmp_path / "log"
    line = f"EXTRUSION_CALIBRATE SPEEDS={','.join(map(str, speeds))} WIDTHS={widths}\n"
    run = simulate(line, config=config(tmp_path, "[extrusion]\n"), more=["--log", str(log)])
    assert run.status == 0, run.stderr
    found = re.search(r"Die swell: ([0-9.]+) mm \+ ([0-9.e-]+) s", log.read_text())
    assert found is not None
    # widths are given to 0.1 um
    assert float(found[1]) == pytest.approx(truth.hole_mm, abs=1e-3)
    assert float(found[2]) == pytest.approx(truth.gain_s, rel=0.02)


def test_ooze_is_pushed_back_by_the_model(simulate: Simulate, tmp_path: Path) -> None:
    log = tmp_path / "log"
    more = "[extrusion]\noverrun_length: 1.5\noverrun_time: 3\n"
    gcode = "M104 S215\nG28\nM83\nM109 S215\nG1 E10 F240\nM400\nG4 P3000\nM400\nPRIME_OOZE\nM400\n"
    run = simulate(gcode, config=config(tmp_path, more), more=["--log", str(log)])
    assert run.status == 0, run.stderr
    pushed = re.search(r"Pushed ([0-9.]+) mm", log.read_text())
    assert pushed is not None
    # 1.5 (1 - exp(-3/3)) = 0.948 mm; motion ends and is looked at within 0.5 s
    assert float(pushed[1]) == pytest.approx(0.948, abs=0.12)
    e = run.column("e_mm")
    assert e[-1] - 10.0 == pytest.approx(float(pushed[1]), abs=0.02)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("EXTRUSION_CALIBRATE SPEEDS=1,two WIDTHS=0.4,0.5", "numbers with commas"),
        ("EXTRUSION_CALIBRATE SPEEDS=1 WIDTHS=0.4", "two different speeds"),
        ("EXTRUSION_CALIBRATE SPEEDS=1,2 WIDTHS=0.4,-1", "above zero"),
        ("EXTRUSION_CALIBRATE", "SPEEDS"),
        ("PRIME_OOZE", "overrun_length"),
    ],
)
def test_a_bad_command_says_what_would_be_right(
    simulate: Simulate, tmp_path: Path, line: str, words: str
) -> None:
    log = tmp_path / "log"
    simulate(line + "\n", config=config(tmp_path, "[extrusion]\n"), more=["--log", str(log)])
    assert words in log.read_text()
