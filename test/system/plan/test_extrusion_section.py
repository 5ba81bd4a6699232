"""Dry runs, die swell from measured strands, ooze pushed back: commands of [dry_run] and [extrusion]."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from extras import extrusion
from system.conftest import Simulate, machine, square
from thermal.plan.extrusion import DieSwell, Overrun, exit_diameter


def test_a_dry_run_follows_the_path_above_it_without_heat_or_filament(
    simulate: Simulate, tmp_path: Path
) -> None:
    gcode = (
        "G28\nG1 Z5 F600\nDRY_RUN ENABLE=1 Z_OFFSET=8\n"
        + square(1).replace("G28\n", "")
        + "DRY_RUN ENABLE=0\nG1 Z3\nM400\n"
    )
    run = simulate(gcode, config=machine(tmp_path, "[dry_run]\n"))
    assert run.status == 0, run.stderr
    x, z, e = (np.array(run.column(name)) for name in ("x_mm", "z_mm", "e_mm"))
    path = (x > 59.0) & (x < 81.0) & (z > 7.0)
    assert path.sum() > 100 and np.median(z[path]) == pytest.approx(
        8.3, abs=0.02
    )  # the square's Z0.3, lifted
    assert np.ptp(e) < 0.01
    assert max(run.column("power_w")) < 2.0 and max(run.column("target_c")) == 0.0
    assert z[-1] == pytest.approx(3.0, abs=0.02)  # as before
    left_out = re.search(r"(\d+) heating commands left out", run.log.read_text())
    assert left_out is not None and int(left_out[1]) == 3  # M104, M109, M104


def test_a_second_dry_run_and_an_end_without_one_are_refused(simulate: Simulate, tmp_path: Path) -> None:
    for lines, words in (
        ("DRY_RUN ENABLE=0\n", "none is under way"),
        ("DRY_RUN ENABLE=1\nDRY_RUN ENABLE=1\n", "under way already"),
        ("DRY_RUN Z_OFFSET=-1 ENABLE=1\n", "Z_OFFSET"),
    ):
        run = simulate(lines, config=machine(tmp_path, "[dry_run]\n"))
        assert words in run.log.read_text()


def test_die_swell_is_fitted_from_measured_strands(simulate: Simulate, tmp_path: Path) -> None:
    truth = DieSwell(0.42, 0.0035)
    speeds = (0.5, 1.0, 2.0, 4.0)
    widths = ",".join(f"{exit_diameter(truth, v, 1.75):.4f}" for v in speeds)
    line = f"EXTRUSION_CALIBRATE SPEEDS={','.join(map(str, speeds))} WIDTHS={widths}\n"
    run = simulate(line, config=machine(tmp_path, "[extrusion]\n"))
    assert run.status == 0, run.stderr
    found = re.search(r"Die swell: ([0-9.]+) mm \+ ([0-9.e-]+) s", run.log.read_text())
    assert found is not None
    # widths are given to 0.1 um
    assert float(found[1]) == pytest.approx(truth.hole_mm, abs=1e-3)
    assert float(found[2]) == pytest.approx(truth.gain_s, rel=0.02)


HOT = "M104 S215\nG28\nG1 Z40 F1200\nM109 S215\nM83\n"


def test_strands_come_at_the_speeds_asked_for_whatever_the_overrides(
    simulate: Simulate, tmp_path: Path
) -> None:
    gcode = (
        HOT + "M82\nG92 E0\nM220 S50\nM221 S80\nEXTRUSION_CALIBRATE SPEEDS=1,4 PAUSE=1\nG1 E5 F240\nM400\n"
    )
    run = simulate(gcode, config=machine(tmp_path, "[extrusion]\n"))
    assert run.status == 0, run.stderr
    feed_mm_s = np.array(run.column("flow_mm3_s")) / (math.pi / 4.0 * 1.75**2)
    for speed_mm_s in (1.0, 4.0):
        at_speed_s = 0.01 * np.count_nonzero(np.abs(feed_mm_s - speed_mm_s) < 0.15)
        assert at_speed_s == pytest.approx(15.0 / speed_mm_s, rel=0.15)  # all but the ends
    # 2 strands of 15 mm, then 5 mm at 80 %: M82 and M221 count again
    assert run.column("e_mm")[-1] == pytest.approx(34.0, abs=0.02)


def test_ooze_is_pushed_back_by_the_model_once(simulate: Simulate, tmp_path: Path) -> None:
    """The wait is still queued as the commands are read."""
    more = "[extrusion]\noverrun_length: 1.5\noverrun_time: 3\n"
    gcode = HOT + "G1 E10 F240\nM400\nG4 P3000\nPRIME_OOZE\nPRIME_OOZE\nM400\n"
    run = simulate(gcode, config=machine(tmp_path, more))
    assert run.status == 0, run.stderr
    pushed = re.findall(r"Pushed ([0-9.]+) mm", run.log.read_text())
    assert len(pushed) == 1 and "Nothing has oozed" in run.log.read_text()
    # 1.5 (1 - exp(-3/3)) = 0.948 mm; motion ends and is looked at within 0.5 s
    assert float(pushed[0]) == pytest.approx(0.948, abs=0.12)
    assert run.column("e_mm")[-1] - 10.0 == pytest.approx(float(pushed[0]), abs=0.02)


def test_what_a_cold_interval_pushes_out_is_made_good_too(simulate: Simulate, tmp_path: Path) -> None:
    more = "[extrusion]\noverrun_length: 1.5\noverrun_time: 3\noverrun_reheat: 5\n"
    gcode = HOT + "G1 E10 F240\nM400\nM104 S0\nG4 P30000\nM400\nM109 S215\nPRIME_OOZE\nM400\n"
    run = simulate(gcode, config=machine(tmp_path, more))
    assert run.status == 0, run.stderr
    assert min(run.column("true_c")[-1000:]) < 170.0  # it was cold
    assert run.column("e_mm")[-1] - 10.0 == pytest.approx(1.5 + 5.0, abs=0.02)


class ColdPrinter:
    """Its G-code refuses to extrude, as of a cold nozzle."""

    def __init__(self) -> None:
        self.ran: list[str] = []

    def lookup_object(self, name: str) -> ColdPrinter:
        return self

    def get_reactor(self) -> None:
        return None

    def run_script_from_command(self, script: str) -> None:
        self.ran += script.split("\n")
        if "G1" in script:
            raise RuntimeError("Extrude below minimum temp")


def test_a_refused_push_leaves_the_modes_of_extrusion_as_they_were() -> None:
    printer = ColdPrinter()
    section = extrusion.Extrusion(printer, None, Overrun(1.5, 2.0), 1.75, 2.0)
    with pytest.raises(RuntimeError, match="minimum temp"):
        section._extrude(["G1 E1 F120"])
    first, last = printer.ran[0], printer.ran[-1]
    assert first.startswith("SAVE_GCODE_STATE") and last == first.replace("SAVE", "RESTORE")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("EXTRUSION_CALIBRATE SPEEDS=1,two WIDTHS=0.4,0.5", "numbers with commas"),
        ("EXTRUSION_CALIBRATE SPEEDS=1 WIDTHS=0.4", "two different speeds"),
        ("EXTRUSION_CALIBRATE SPEEDS=1,2 WIDTHS=0.4,-1", "above zero"),
        ("EXTRUSION_CALIBRATE SPEEDS=1,2 WIDTHS=0.5,0.4", "thinner as the speed rises"),
        ("EXTRUSION_CALIBRATE SPEEDS=1,2", "too cold"),
        (HOT + "EXTRUSION_CALIBRATE SPEEDS=1,500", "slower than asked for"),
        (HOT + "EXTRUSION_CALIBRATE SPEEDS=4 LENGTH=99", "LENGTH=99 is more than"),
        (HOT + "G1 Z0.2\nEXTRUSION_CALIBRATE SPEEDS=1", "20 mm of air"),
        ("EXTRUSION_CALIBRATE", "SPEEDS"),
        ("PRIME_OOZE", "overrun_length"),
    ],
)
def test_a_bad_command_says_what_would_be_right(
    simulate: Simulate, tmp_path: Path, line: str, words: str
) -> None:
    more = "[extruder]\nmax_extrude_only_distance: 50\n[extrusion]\n"
    run = simulate(line + "\n", config=machine(tmp_path, more))
    assert words in run.log.read_text()
