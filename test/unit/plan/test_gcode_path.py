"""Sliced files as timed path without a printer, cut into pieces for the temperature plan, and back into a file."""

from __future__ import annotations

import functools
import itertools
import json
import math
import operator
import re
import subprocess
import sys
from pathlib import Path

import pytest

import chelper
from lookahead import LookAheadQueue
from simulation.gcode_path import GcodePath, Limits
from thermal.plan.path_pieces import Asked, PathPieces
from thermal.plan.planner import Piece

ROOT = Path(__file__).resolve().parents[3]
AREA = math.pi / 4 * 1.75**2
LINES = """
M140 S90
M104 S240
G90
M83
;LAYER_CHANGE
;HEIGHT:0.3
G1 Z0.3 F600
;TYPE:External perimeter
G1 X20 Y0 F6000
G1 X60 Y0 E2.0 F3000
G1 X60 Y40 E2.0
EXCLUDE_OBJECT_START NAME=box
M104.1 S230
G1 X20 Y40 E2.0
EXCLUDE_OBJECT_END NAME=box
G4 P500
M104 S0
G1 X20 Y0 E2.0
"""


LIMITS = Limits(200.0, 1000.0)
PLAIN = Asked(base_c=240.0)


def taken(path: PathPieces, ask=lambda time_s, layer, z_mm: PLAIN) -> list[Piece]:  # type: ignore[no-untyped-def]
    """All pieces that it has."""
    pieces: list[Piece] = []

    ffi, lib = chelper.get_ffi()
    rows = ffi.new("struct tempplan_piece **")

    def take(waiting, wish) -> int:  # type: ignore[no-untyped-def]
        count = lib.tempplan_path_run(waiting, wish, rows)
        for row in ffi.unpack(rows[0], count) if count else ():
            place = tuple(row.start_pos), tuple(row.end_pos)
            rest = row.flow_mm3_s, row.height_mm, row.fan, row.wish_c, row.base_c, row.pace
            pieces.append(Piece(row.start_s, row.end_s, *place, *rest))
        return int(path.facts().waiting)

    path.feed(ask, take)
    return pieces


def pieces_of(moves, ask=lambda time_s, layer, z_mm: PLAIN) -> list[Piece]:  # type: ignore[no-untyped-def]
    path = PathPieces(AREA, longest_mm=10.0)
    path.note(moves)
    return taken(path, ask)


def moves_of(text: str, tmp_path: Path, other_nozzles: frozenset[int] = frozenset()):  # type: ignore[no-untyped-def]
    path = tmp_path / "part.gcode"
    path.write_text(text)
    reader = GcodePath(LIMITS, other_nozzles=other_nozzles)
    return reader, [move for batch in reader.moves(path) for move in batch]


def test_moves_follow_each_other_in_time_and_know_their_line(tmp_path: Path) -> None:
    reader, moves = moves_of(LINES, tmp_path)
    assert reader.bed_c == 90.0
    lines = LINES.split("\n")
    assert all(lines[m.line].startswith("G1") for m in moves)
    ends = [m.move.print_time + m.move.accel_t + m.move.cruise_t + m.move.decel_t for m in moves]
    gaps = [b.move.print_time - end for end, b in zip(ends, moves[1:], strict=False)]
    assert gaps == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.5], abs=1e-9)  # only the dwell
    extruding = [m for m in moves if m.move.axes_d[3] > 0.0]
    # 40 mm at 50 mm/s and 1000 mm/s2: at least 0.8 s and what the corner costs
    assert all(0.8 <= m.move.accel_t + m.move.cruise_t + m.move.decel_t < 0.95 for m in extruding)
    assert [m.nozzle_c for m in extruding] == [240.0] * 4  # S0 is the end of a print, not a wish
    assert [m.wishes.feature for m in extruding] == ["external perimeter"] * 4
    assert [m.wishes.object_name for m in extruding] == ["", "", "BOX", ""]
    assert [m.wishes.explicit_c for m in extruding[2:]] == [230.0, 230.0]


def test_relative_and_absolute_coordinates_give_the_same_path(tmp_path: Path) -> None:
    absolute = "G90\nM82\nG92 E5\nG1 X10 Y10 F3000\nG1 X20 Y10 E6\nG92 E0\nG1 X20 Y20 E1\n"
    relative = "G91\nM83\nG1 X10 Y10 F3000\nG1 X10 E1\nG1 Y10 E1\n"
    ways = []
    for text in (absolute, relative):
        _, moves = moves_of(text, tmp_path)
        ways.append([(m.move.end_pos[:3], round(m.move.axes_d[3], 9)) for m in moves])
    assert ways[0] == ways[1]


def with_numbers(text: str) -> str:
    """As sent to a serial port: line numbers and check sums."""
    lines = []
    for number, line in enumerate(text.split("\n")):
        told = f"N{number} {line}"
        lines.append(
            f"{told}*{functools.reduce(operator.xor, told.encode())}" if line[:1] not in ("", ";") else line
        )
    return "\n".join(lines)


def squeezed(text: str) -> str:
    return "\n".join(line if line[:1] in ";E" else line.replace(" ", "") for line in text.split("\n"))


def in_volume(text: str) -> str:
    """E in mm³, as PrusaSlicer writes it with "use volumetric E"."""
    return "M200 D1.75\n" + re.sub(r"E([0-9.]+)", lambda m: f"E{float(m[1]) * AREA:.9f}", text)


@pytest.mark.parametrize(
    "write",
    [
        with_numbers,
        squeezed,
        in_volume,
        str.lower,
        lambda text: "\ufeff" + text[1:],  # the file begins with M140
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("E2.0\n", "E2.0 ; ☃\n"),
    ],
)
def test_a_file_says_the_same_however_its_lines_are_written(write, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    ways = []
    for text in (LINES, write(LINES)):
        reader, moves = moves_of(text, tmp_path)
        assert reader.bed_c == 90.0
        facts = [(m.wishes, m.nozzle_c, m.move.end_pos[:3], round(m.move.axes_d[3], 7)) for m in moves]
        ways.append([str(fact) for fact in facts])
    assert ways[0] == ways[1] and len(ways[0]) == 6


def test_what_a_tool_with_another_nozzle_lays_is_left_out(tmp_path: Path) -> None:
    text = (
        "M83\nM104 T0 S210\nM104 T1 S250\nG1 X10 E1 F3000\nT1\nM104 S255\nG1 X20 E1\nM104 T0 S180\nG1 X30\n"
        "T0\nM104 S215\nG1 X40 E1\n"
    )
    reader, moves = moves_of(text, tmp_path, frozenset({1}))
    assert [(m.move.end_pos[0], m.move.axes_d[3]) for m in moves] == [(10, 1), (20, 0), (30, 0), (40, 1)]
    assert [m.nozzle_c for m in moves] == [210.0, 210.0, 180.0, 215.0] and reader.other_tool_line == 4
    reader, moves = moves_of(text, tmp_path)  # several filaments, one nozzle
    assert sum(m.move.axes_d[3] for m in moves) == 3 and reader.other_tool_line == -1
    assert [m.nozzle_c for m in moves] == [250.0, 255.0, 180.0, 215.0]


def test_pieces_hold_all_the_filament_and_all_the_time(tmp_path: Path) -> None:
    _, moves = moves_of(LINES, tmp_path)
    pieces = pieces_of([m.move for m in moves])
    laid = [p for p in pieces if p.flow_mm3_s > 0.0]
    assert sum(p.flow_mm3_s * (p.end_s - p.start_s) for p in laid) == pytest.approx(8.0 * AREA)
    assert max(math.dist(p.start_mm, p.end_mm) for p in laid) <= 10.0 + 1e-9
    for a, b in itertools.pairwise(pieces):
        assert b.start_s - a.end_s == pytest.approx(0.0, abs=1e-9) or b.start_s - a.end_s == pytest.approx(
            0.5
        )
    slow, fast = min(p.flow_mm3_s for p in laid), max(p.flow_mm3_s for p in laid)
    assert fast == pytest.approx(2.0 * AREA / 40.0 * 50.0) and slow < fast  # cruise, and where it speeds up
    assert all(p.height_mm == pytest.approx(0.3) for p in laid)


def test_layers_are_seen_where_material_is_laid(tmp_path: Path) -> None:
    """What is asked for by place is asked for again at each: `seen` are the layers and heights it was told."""
    heights = (0.3, 0.3, 0.5, 0.7, 0.9, 0.2, 0.4)
    text = "".join(f"G1 Z{z}\nG1 X{10 * (1 + i % 2)} E1 F600\n" for i, z in enumerate(heights))
    _, moves = moves_of(f"M83\n{text}", tmp_path)
    seen = []

    def ask(time_s: float, layer: int, z_mm: float) -> Asked:
        seen.append((layer, z_mm))
        return Asked(wish_c=200.0 + layer, by_place=True)

    pieces = pieces_of([m.move for m in moves], ask)
    laid = [p for p in pieces if p.flow_mm3_s > 0.0]
    at = {p.end_mm[2]: p for p in laid}
    assert [at[z].height_mm for z in heights] == pytest.approx([0.3, 0.3, 0.2, 0.2, 0.2, 0.2, 0.2])
    assert [at[z].wish_c for z in heights] == [
        201.0,
        201.0,
        202.0,
        203.0,
        204.0,
        201.0,
        202.0,
    ]  # 0.2: another object
    assert [z for _, z in seen[1:]] == pytest.approx([0.3, 0.5, 0.7, 0.9, 0.2, 0.4])
    told = pieces_of([m.move for m in moves], lambda t, layer, z: Asked(height_mm=0.15))
    assert {p.height_mm for p in told if p.flow_mm3_s > 0.0} == {0.15}  # the slicer knows better


def test_another_wish_begins_with_the_first_move_that_starts_behind_its_mark(tmp_path: Path) -> None:
    text = "M83\n" + "".join(f"G1 X{10 * (i + 1)} E1 F600\n" for i in range(6))
    _, moves = moves_of(text, tmp_path)
    starts = [m.move.print_time for m in moves]

    def ask(time_s: float, layer: int, z_mm: float) -> Asked:
        before = time_s < starts[3]
        return Asked(wish_c=210.0 if before else 230.0, until_s=starts[3] if before else math.inf)

    pieces = pieces_of([m.move for m in moves], ask)
    assert [p.wish_c for p in pieces] == [210.0 if p.start_s < starts[3] - 1e-9 else 230.0 for p in pieces]
    assert {p.wish_c for p in pieces} == {210.0, 230.0}


def test_moves_noted_from_the_look_aheads_row_are_those_of_its_objects(tmp_path: Path) -> None:
    _, moves = moves_of(LINES, tmp_path)
    queue = LookAheadQueue(LIMITS)
    for timed in moves:
        queue.add_move(timed.move, LIMITS)
    count = queue.plan()
    from_row, from_objects = PathPieces(AREA), PathPieces(AREA)
    assert from_row.note_planned(queue.row, count, 1.0, 0.5, 0.0)  # a new stretch begins
    planned, time_s = queue.take(count), 1.0
    for move in planned:
        move.print_time = time_s
        time_s += move.accel_t + move.cruise_t + move.decel_t
    from_objects.note(planned, 0.5)
    rows = [list(map(repr, taken(path))) for path in (from_row, from_objects)]  # NaN is not itself
    assert rows[0] == rows[1] and len(rows[0]) > count // 2
    assert from_row.facts().end_s == pytest.approx(time_s)


def test_what_has_been_laid_unplanned_is_forgotten(tmp_path: Path) -> None:
    _, moves = moves_of("M83\n" + "".join(f"G1 X{10 * (i + 1)} E1 F600\n" for i in range(6)), tmp_path)
    path = PathPieces(AREA)
    path.note([m.move for m in moves])
    path.drop(moves[2].move.print_time + 1e-9)
    assert path.facts().waiting == 4 and path.facts().next_s == moves[2].move.print_time
    path.drop()
    assert not path.facts().waiting and math.isnan(path.facts().next_s)


CONFIG = """
[printer]
kinematics: cartesian
max_velocity: 200
max_accel: 3000
[extruder]
max_temp: 300
[temperature_plan]
material: ABS
features:
  external perimeter: 235
"""


def tool(
    tmp_path: Path, *options: str, config: str = CONFIG, gcode: str = LINES
) -> subprocess.CompletedProcess[str]:
    (tmp_path / "printer.cfg").write_text(config)
    (tmp_path / "part.gcode").write_text(gcode)
    command = [ROOT / "scripts" / "plan_temperature.py", tmp_path / "part.gcode", *options]
    if "--config" not in options:
        command += ["--config", tmp_path / "printer.cfg"]
    return subprocess.run([sys.executable, *map(str, command)], capture_output=True, text=True, check=False)


def test_the_tool_writes_a_page_figures_and_a_file_with_commands(tmp_path: Path) -> None:
    page, figures, planned = tmp_path / "plan.html", tmp_path / "plan.json", tmp_path / "planned.gcode"
    done = tool(
        tmp_path,
        "--report",
        str(page),
        "--json",
        str(figures),
        "--emit",
        str(planned),
        "--heater",
        "induction",
    )
    assert done.returncode == 0, done.stderr
    assert "welded" in done.stdout
    found = json.loads(figures.read_text())
    assert found["moves"] == 4 and found["length_mm"] == pytest.approx(160.0)
    text = page.read_text()
    assert "@" + "DATA@" not in text and '"ways"' in text and "http" not in text
    emitted = planned.read_text().split("\n")
    plain = [line for line in emitted if not line.endswith(";planned")]
    assert plain == LINES.split("\n")  # nothing else is changed
    targets = [int(line.split()[1][1:]) for line in emitted if line.endswith(";planned")]
    assert targets and all(170 <= t <= 300 for t in targets)


@pytest.mark.parametrize("heater", ["induction", "slow"])
def test_what_is_written_keeps_away_from_max_temp(tmp_path: Path, heater: str) -> None:
    """At which the printer shuts down."""
    config = CONFIG.replace("300", "245").replace(
        "features:\n  external perimeter: 235", "interface_temp: 230"
    )
    planned = tmp_path / "planned.gcode"
    lines = (
        LINES.replace("M104.1 S230\n", "").replace("S240", "S225").replace("E2.0", "E0.2")
    )  # slow enough for either heater
    done = tool(
        tmp_path, "--emit", str(planned), "--heater", heater, "--step", "0.5", config=config, gcode=lines
    )
    assert done.returncode == 0, done.stderr
    targets = [
        int(line.split()[1][1:]) for line in planned.read_text().split("\n") if line.endswith(";planned")
    ]
    assert targets and max(targets) <= 240, targets


@pytest.mark.parametrize(
    ("options", "config", "gcode", "words"),
    [
        (["--set", "material=WOOD"], CONFIG, LINES, "material"),
        (["--set", "material"], CONFIG, LINES, "OPTION=VALUE"),
        (["--set", "smoth_time=1"], CONFIG, LINES, "did you mean smooth_time"),
        (["--set", "nosuch=1"], CONFIG, LINES, "no such option"),
        (["--step", "nan"], CONFIG, LINES, "0.1 to 50"),
        (["--step", "-3"], CONFIG, LINES, "0.1 to 50"),
        ([], CONFIG.replace("235", "warm"), LINES, "'warm' is not a number"),
        ([], CONFIG, "G28\nM104 S200\n", "no line of it extrudes"),
        (
            [],
            CONFIG,
            LINES + "M220 Sx\nM106 S1\nM104.1 S200\nSET_SEGMENT_TEMPERATURE TEMP=hot\n",
            "line 23: 'SET_SEGMENT",
        ),
        ([], CONFIG, LINES + "G1 X1000000 E5\n", "line 20: 'G1 X1000000 E5': there is no printer so large"),
        (
            ["--emit", "out"],
            CONFIG + "[extruder1]\n",
            LINES + "T1\nG1 X5 E2\n",
            "line 20: this tool has a nozzle",
        ),
        ([], CONFIG.replace("300", "190"), LINES, "'M104 S240': max_temp of the printer is 190 C"),
        (["--config", "/nonexistent.cfg"], CONFIG, LINES, "/nonexistent.cfg"),
        ([], CONFIG.replace("max_accel: 3000", "max_accel: -1"), LINES, "max_accel"),
    ],
)
def test_wrong_input_is_told_in_a_line(
    tmp_path: Path, options: list[str], config: str, gcode: str, words: str
) -> None:
    done = tool(tmp_path, *options, config=config, gcode=gcode)
    assert done.returncode == 2
    assert words in done.stderr and "Traceback" not in done.stderr


def shown_heights(page: Path) -> list[float]:
    found = re.search(r'"heights": (\[[^\]]*\])', page.read_text())
    assert found is not None
    return list(json.loads(found[1]))


@pytest.mark.parametrize("marked", [True, False])
def test_a_vase_is_shown_in_layers_although_its_path_rises_all_the_time(tmp_path: Path, marked: bool) -> None:
    """Six turns of 48 moves, 0.2 mm each: by the slicer's marks a layer a turn, without them steps of 0.04 mm."""
    lines = ["M83", "M104 S240", "G1 Z0.2 F3000"]
    for number in range(6 * 48):
        if marked and number % 48 == 0:
            lines.append(";LAYER_CHANGE")
        angle = 2.0 * math.pi * number / 48
        lines.append(
            f"G1 X{50 + 20 * math.cos(angle):.3f} Y{50 + 20 * math.sin(angle):.3f} Z{0.2 + number / 240:.4f} E0.1"
        )
    done = tool(tmp_path, "--report", str(tmp_path / "page.html"), gcode="\n".join(lines))
    assert done.returncode == 0, done.stderr
    heights = shown_heights(tmp_path / "page.html")
    steps = [b - a for a, b in itertools.pairwise(heights)]
    assert len(heights) == (6 if marked else 29)  # 288 moves of 1/240 mm, ten to a step
    assert steps == pytest.approx([0.2 if marked else 0.0417] * len(steps), abs=0.01)


def test_a_file_may_be_planned_in_place(tmp_path: Path) -> None:
    """--emit to the file that is read: the same as to another one; a failure leaves what was there."""
    other, part = tmp_path / "other.gcode", tmp_path / "part.gcode"
    assert tool(tmp_path, "--heater", "induction", "--emit", str(other)).returncode == 0
    done = tool(tmp_path, "--heater", "induction", "--emit", str(part))
    assert done.returncode == 0, done.stderr
    assert part.read_bytes() == other.read_bytes() != b""
    assert part.stat().st_mode == other.stat().st_mode
    done = tool(tmp_path, "--emit", str(part), gcode="G28\n")
    assert done.returncode == 2 and part.read_text() == "G28\n"
    assert {path.name for path in tmp_path.iterdir()} == {"printer.cfg", "part.gcode", "other.gcode"}
