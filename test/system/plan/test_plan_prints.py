"""Where a print begins and ends for the temperature plan: with its first line, and when what is queued is deposited."""

from __future__ import annotations

import csv
import itertools
from pathlib import Path

import pytest

from plan_rig import SECTION, Watched, watch
from system.conftest import machine
from thermal.control.control_api import Reference

SQUARE = "".join(f"G1 X{x} Y{y} E1.5 F2400\n" for x, y in ((80, 60), (80, 80), (60, 80), (60, 60)))
JUMP_C = 0.05  # corners within 0.02 degC of a line are left out of both references


def print_it(folder: Path, gcode: str, more: str = "", until_s: float = 60.0) -> Watched:
    config, part = machine(folder, SECTION + more), folder / "part.gcode"
    part.write_text(gcode)
    watched = watch(config, part, until_s=until_s)
    assert watched.outcome is not None and watched.outcome.status == 0, watched.outcome
    assert not watched.tracebacks
    return watched


def jumps_c(watched: Watched) -> list[float]:
    """Where one reference of the plan takes over from another, degC."""
    planned = [(e.now_s, Reference.of(e.corners)) for e in watched.emitted if not e.by_user]
    return [
        abs(after.at(now_s) - before.at(now_s)) for (_, before), (now_s, after) in itertools.pairwise(planned)
    ]


def summaries(watched: Watched) -> int:
    return sum(record.getMessage().startswith("Temperature plan (PLA") for record in watched.log)


@pytest.mark.parametrize("first", ["M104.1 S228", ";TYPE:External perimeter"])
def test_the_first_line_of_a_file_may_ask_already(tmp_path: Path, first: str) -> None:
    record = tmp_path / "rows.csv"
    body = f"{first}\nM104 S215\nG28\nM83\nG1 X60 Y60 Z0.3 F6000\nM109 S215\n{SQUARE}M400\n"
    print_it(tmp_path, body, f"record: {record}\nfeatures:\n  external perimeter: 228\n")
    with record.open(newline="") as stream:
        wanted = {float(row["wanted_melt_c"]) for row in csv.DictReader(stream)}
    assert wanted == {228.0}


@pytest.mark.parametrize(("first", "bed_c"), [("", 71.0), ("M140 S95\n", 95.0)])
def test_the_bed_that_the_file_asks_for_is_the_one_it_is_deposited_on(
    tmp_path: Path, first: str, bed_c: float
) -> None:
    """As offline; bed_temp is for a bed without a target."""
    record = tmp_path / "rows.csv"
    body = f"{first}M104 S215\nG28\nM83\nG1 X60 Y60 Z0.3 F6000\nM109 S215\n{SQUARE}M400\n"
    print_it(tmp_path, body, f"record: {record}\nbed_temp: 71\n")
    with record.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert float(rows[0]["substrate_c"]) == pytest.approx(bed_c, abs=0.1)


def test_path_that_is_queued_at_the_end_of_a_file_is_deposited_as_planned(tmp_path: Path) -> None:
    """Neither M400 nor M104 S0 ends this file: 2 s of path are to come after its last byte."""
    steps = "".join(f"M104.1 S{200 + 30 * (i % 2)}\n{SQUARE}" for i in range(5))
    watched = print_it(tmp_path, f"M104 S215\nG28\nM83\nG1 X60 Y60 Z0.3 F6000\nM109 S215\n{steps}")
    assert watched.emitted[-1].corners[-1][0] > watched.roads[-1].end_s - 0.2
    assert max(jumps_c(watched)) < JUMP_C
    assert summaries(watched) == 1


@pytest.mark.parametrize("wait_s", [0.05, 2.0])
def test_a_print_that_follows_at_once_is_led_on_from_where_the_nozzle_is(
    tmp_path: Path, wait_s: float
) -> None:
    (tmp_path / "second.gcode").write_text(f"G90\nM83\nM104.1 S230\n{SQUARE * 3}")
    more = f"""
[virtual_sdcard]
path: {tmp_path}
[delayed_gcode next]
initial_duration: 1
gcode:
  {{% if printer.print_stats.state == "complete" and printer.print_stats.filename == "part.gcode" %}}
    SDCARD_PRINT_FILE FILENAME=second.gcode
  {{% else %}}
    UPDATE_DELAYED_GCODE ID=next DURATION={wait_s}
  {{% endif %}}
"""
    body = f"M104 S215\nG28\nM83\nG1 X60 Y60 Z0.3 F6000\nM109 S215\nM104.1 S200\n{SQUARE * 3}"
    watched = print_it(tmp_path, body, more)
    assert max(jumps_c(watched)) < JUMP_C
    assert summaries(watched) == 2
