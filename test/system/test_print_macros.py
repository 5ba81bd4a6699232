"""PAUSE, RESUME and CANCEL_PRINT of the printer that `make printer` sets up: where the head goes, how hot it is."""

from __future__ import annotations

import csv
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from simulation import world
from simulation.printer_data import PrinterData
from system.conftest import ROOT, Simulate

TARGET_C = 210.0
PLACE_MM = (80.0, 60.0)  # where the path is when the pause comes
LIFT_MM = 5.0

# Two lines with a pause at the end of the first. A delayed_gcode does what is to happen during the pause.
PRINT = f"""
M104 S{TARGET_C:.0f}
G28
G90
M83
G1 X60 Y60 Z0.3 F6000
M109 S{TARGET_C:.0f}
G1 X{PLACE_MM[0]:.0f} Y{PLACE_MM[1]:.0f} E0.66528 F2400
UPDATE_DELAYED_GCODE ID=later DURATION=15
{{pause}}
G1 X80 Y80 E0.66528 F2400
G1 X60 Y80 E0.66528 F2400
"""


@dataclass(frozen=True)
class Row:
    """One of the trace."""

    t_s: float
    target_c: float
    true_c: float
    flow_mm3_s: float
    x_mm: float
    y_mm: float
    z_mm: float
    e_mm: float
    bed_target_c: float

    @property
    def place(self) -> tuple[float, float]:
        return self.x_mm, self.y_mm

    @property
    def is_parked(self) -> bool:
        return self.x_mm < 10.0 and self.y_mm < 10.0 and self.z_mm > 0.9 * LIFT_MM


def prepared(folder: Path, *more: str) -> Path:
    """The config of `make printer`, with sections of the test's own."""
    data = PrinterData(folder / "data", ROOT)
    data.prepare(ROOT / "config" / "sim-induction.cfg")
    data.config.write_text("\n".join([data.config.read_text(), *more]))
    return data.config


def printed(
    simulate: Simulate, folder: Path, later: str, pause: str = "PAUSE"
) -> tuple[list[Row], list[str]]:
    """The trace of PRINT with `pause`, 15 s after which `later` is run; and the faults of the run."""
    config = prepared(folder, f"[delayed_gcode later]\ngcode:\n  {later}\n")
    run = simulate(PRINT.format(pause=pause), config=config, more=["--until", "60"])
    assert run.status == 0, run.stderr
    with run.trace.open(newline="") as stream:
        rows = [
            Row(**{name: float(row[name]) for name in Row.__dataclass_fields__})
            for row in csv.DictReader(stream)
        ]
    return rows, run.summary["faults"]


def end_of_first_line(rows: list[Row]) -> int:
    """Index of the row in which the filament of the first line is out."""
    flows = [row.flow_mm3_s > 0.0 for row in rows]
    return flows.index(False, flows.index(True))


def test_pause_parks_and_cools_and_resume_goes_on_where_it_was_at_temperature(
    simulate: Simulate, tmp_path: Path
) -> None:
    rows, faults = printed(simulate, tmp_path, "RESUME")
    assert faults == []
    pause = end_of_first_line(rows)
    assert all(abs(row.true_c - TARGET_C) < 10.0 for row in rows if row.flow_mm3_s > 0.0), "printed hot"

    parked = [i for i, row in enumerate(rows) if i > pause and row.is_parked]
    assert rows[parked[0]].t_s - rows[pause].t_s < 5.0, "soon"
    assert rows[parked[-1]].t_s - rows[parked[0]].t_s > 8.0, "until RESUME has heated"
    assert rows[parked[0]].target_c == 0.0
    assert min(rows[i].true_c for i in parked) < 0.7 * TARGET_C
    # the way there and back: up before aside, and from above down onto the place
    over_part = [row for row in rows[pause:] if row.z_mm < 0.9 * LIFT_MM and row.flow_mm3_s == 0.0]
    assert all(abs(row.x_mm - 80.0) < 0.1 for row in over_part if row.t_s < rows[parked[0]].t_s)

    again = next(i for i in range(parked[-1], len(rows)) if rows[i].flow_mm3_s > 0.0 and rows[i].z_mm < 1.0)
    assert rows[again].place == pytest.approx(PLACE_MM, abs=0.5)
    assert rows[again].z_mm == pytest.approx(0.3, abs=0.01)
    assert rows[again].target_c == TARGET_C
    assert rows[-1].place == pytest.approx((60.0, 80.0), abs=0.05)
    # three lines of filament: what the pause drew back it has given again
    assert rows[-1].e_mm - rows[0].e_mm == pytest.approx(3 * 0.66528, abs=0.01)


@pytest.mark.parametrize("pause", ["PAUSE", "", "M140 S50\nPAUSE"], ids=["paused", "printing", "hot bed"])
def test_cancel_lifts_parks_and_switches_the_heaters_off(
    simulate: Simulate, tmp_path: Path, pause: str
) -> None:
    pause = pause or "G1 X60 E0.5 F600\nG1 X80 E0.5\n" * 20  # 80 s: still at it when CANCEL_PRINT comes
    rows, faults = printed(simulate, tmp_path, "CANCEL_PRINT", pause)
    assert faults == []
    last = rows[-1]
    assert last.is_parked
    assert (last.target_c, last.bed_target_c) == (0.0, 0.0)
    assert last.true_c < rows[-200].true_c, "and it cools"
    assert last.e_mm < max(row.e_mm for row in rows) - 1.9, "filament drawn back"


def test_resume_after_a_print_that_was_given_up_heats_nothing(simulate: Simulate, tmp_path: Path) -> None:
    rows, faults = printed(simulate, tmp_path, "CANCEL_PRINT\n  RESUME")
    assert faults == []
    pause = end_of_first_line(rows)
    assert max(row.target_c for row in rows[:pause]) == TARGET_C
    assert {row.target_c for row in rows if row.t_s > rows[pause].t_s + 5.0} == {0.0}


def test_resume_after_the_motors_were_off_says_why_it_does_not(simulate: Simulate, tmp_path: Path) -> None:
    config = prepared(tmp_path, "[delayed_gcode later]\ngcode:\n  M84\n  RESUME\n")
    run = simulate(PRINT.format(pause="PAUSE"), config=config, more=["--until", "40"])
    assert "CANCEL_PRINT" in run.summary["faults"][-1]
    assert run.column("target_c")[-1] == 0.0


# Near the edge of the smallest of them: parking is to be possible from there, too.
EDGE = "G1 X5 Y40 Z5 F3000\n"
EVERY_END = f"G28\nG90\n{EDGE}PAUSE\nRESUME\nPAUSE\nCANCEL_PRINT\n{EDGE}CANCEL_PRINT\n{EDGE}END_PRINT\n"
MACHINES = [path for path in sorted((ROOT / "config").glob("example-*.cfg")) if "induction" not in path.stem]


@pytest.mark.parametrize("machine", MACHINES, ids=lambda path: path.stem)
def test_the_macros_stay_within_the_reach_of_every_machine(machine: Path, tmp_path: Path) -> None:
    """Also where there is no extruder, and where nothing can be homed. In batch mode."""
    config, script = tmp_path / "printer.cfg", tmp_path / "in.gcode"
    macros = ROOT / "config" / "macros-induction.cfg"
    config.write_text(f"[include {machine}]\n[pause_resume]\n[include {macros}]\n")
    script.write_text(EVERY_END if "none" not in machine.stem else EVERY_END.replace("G28\n", ""))
    done = subprocess.run(
        [sys.executable, ROOT / "klippy" / "klippy.py", config, "-i", script, "-o", tmp_path / "out",
         "-d", world.MCU_DICTIONARY],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr


def test_a_picture_of_a_heat_up_lies_beside_the_log(simulate: Simulate, tmp_path: Path) -> None:
    log = tmp_path / "logs" / "klippy.log"
    log.parent.mkdir()
    run = simulate("HEAT_UP_PICTURE NOZZLE=200\nG4 P3000\n", config=prepared(tmp_path), more=["--log", log])
    assert run.status == 0, run.stderr
    picture = log.parent / "heat-up.png"
    assert f"Picture: {picture}" in log.read_text()
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert max(run.column("true_c")) > 195.0 and run.column("target_c")[-1] == 0.0
