"""The offline plan of a file: the path is the host's own, whatever the config makes of its lines."""

from __future__ import annotations

import functools
import itertools
import math
import operator
import re
from pathlib import Path

import pytest

from path_rig import CONFIG, LINES, host_moves, offline_plan
from simulation.plan_offline import OfflinePlan, PlannedMove

AREA = math.pi / 4 * 1.75**2
# Nothing decides but what is asked for by name.
BY_NAME = CONFIG.replace("material: ABS", "material: ABS\nbonding: no\nminimum_speed_factor: 1")
START = "M83\nM104 S240\nG1 Z0.3 F6000\n"


def ends(plan: OfflinePlan) -> list[tuple[float, ...]]:
    return [tuple(round(value, 6) for value in move.end_mm) for move in plan.moves]


def walls(plan: OfflinePlan) -> list[float]:
    return [move.wall_c for move in plan.moves]


def test_planned_moves_know_their_line_and_follow_each_other_in_time(tmp_path: Path) -> None:
    plan = offline_plan(tmp_path, LINES, BY_NAME)
    lines = LINES.split("\n")
    assert [lines[move.line] for move in plan.moves] == [line for line in lines if " E2.0" in line]
    starts = [move.start_s for move in plan.moves]
    # 40 mm at 50 mm/s and 3000 mm/s2: at least 0.8 s and what the corner costs; before the last a dwell
    gaps = [b - a for a, b in itertools.pairwise(starts)]
    assert all(0.8 <= gap < 0.9 for gap in gaps[:2]) and 1.3 <= gaps[2] < 1.4
    assert plan.duration_s == pytest.approx(starts[-1] + gaps[0], abs=0.03)
    assert plan.base_c == 240.0  # S0 is the end of a print, not a target


def test_what_is_asked_for_by_name_is_planned_from_its_line_on(tmp_path: Path) -> None:
    """Roads of 8 s: the nozzle has come to rest on each, whose melt is the requested one."""
    lines = [START]
    for number, before in enumerate(
        (
            ";TYPE:Inner wall",
            ";TYPE:External perimeter",
            "EXCLUDE_OBJECT_START NAME=box",
            "EXCLUDE_OBJECT_END NAME=box\nM104.1 S230",
            "M104.1 S0\nSET_SEGMENT_TEMPERATURE TEMP=225 UNTIL=layer",
            ";LAYER_CHANGE",
        )
    ):
        lines += [before, f"G1 X{0 if number % 2 else 80} E3.3 F600"]
    section = BY_NAME + "objects:\n  box: 245\n"
    melts = [
        move.melt_c
        for move in offline_plan(tmp_path, "\n".join(lines), section, "--heater", "induction").moves
    ]
    base_c = melts[0]
    assert 225.0 < base_c < 240.0  # the melt of a nozzle at 240
    assert melts == pytest.approx([base_c, 235.0, 245.0, 230.0, 225.0, 235.0], abs=2.5)


def with_numbers(text: str) -> str:
    """As sent to a serial port: line numbers and check sums."""
    lines = []
    for number, line in enumerate(text.split("\n")):
        numbered = f"N{number} {line}"
        check = functools.reduce(operator.xor, numbered.encode())
        lines.append(f"{numbered}*{check}" if line[:1] not in ("", ";") else line)
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
    plain, other = (offline_plan(tmp_path, text) for text in (LINES, write(LINES)))
    assert ends(plain) == ends(other) and len(plain.moves) == 4
    assert walls(plain) == pytest.approx(walls(other), abs=1e-4)
    assert plain.summary.length_mm == pytest.approx(other.summary.length_mm)


def test_volumetric_e_and_the_flow_factor_are_multiplied(tmp_path: Path) -> None:
    text = START + "G1 X40 E{:.6f} F1800\n"
    once = offline_plan(tmp_path, text.format(1.0), BY_NAME)
    twice = offline_plan(tmp_path, "M200 D1.75\nM221 S200\n" + text.format(0.5 * AREA), BY_NAME)
    back = offline_plan(tmp_path, "M200 D1.75\nM221 S200\nM200 D0\n" + text.format(0.5), BY_NAME)
    assert walls(twice) == pytest.approx(walls(once), abs=1e-4)
    assert walls(back) == pytest.approx(walls(once), abs=1e-4)


TOOL = "[extruder1]\nmax_temp: 300\n"


def test_what_a_tool_with_another_nozzle_deposits_is_left_out(tmp_path: Path) -> None:
    text = (
        f"{START}G1 X10 E1 F3000\nT1\nM104 S255\nG1 X20 E1\nM104 T0 S230\nG1 X30\n"
        "T0\nG1 X40 E1\nM104 S245\nG1 X50 E1\n"
    )
    plan = offline_plan(tmp_path, text, BY_NAME + TOOL)
    assert [end[0] for end in ends(plan)] == [10.0, 40.0, 50.0]
    assert plan.other_tool_line == 4 and plan.base_c == 245.0
    shared = TOOL.replace("max_temp: 300", "shared_heater: extruder")  # several filaments, one nozzle
    plan = offline_plan(tmp_path, text.replace("M104 T0 S230\n", ""), BY_NAME + shared)
    assert [end[0] for end in ends(plan)] == [10.0, 20.0, 40.0, 50.0] and plan.other_tool_line == -1


def test_macros_of_the_config_deposit_what_they_extrude(tmp_path: Path) -> None:
    """A purge line in a start macro is path, heated as the macro says, and belongs to the macro's line."""
    macro = (
        "[gcode_macro PRINT_START]\ngcode:\n  M104 S{params.HOT}\n  G1 Z0.3 F600\n"
        "  {% for i in range(3) %}\n  G1 X{20 * (i + 1)} E1 F1200\n  {% endfor %}\n"
    )
    plan = offline_plan(tmp_path, "M83\nPRINT_START HOT=238\nG1 Y20 E1\n", BY_NAME + macro)
    assert [(move.line, move.end_mm[:2]) for move in plan.moves] == [
        (1, (20.0, 0.0)), (1, (40.0, 0.0)), (1, (60.0, 0.0)), (2, (60.0, 20.0)),
    ]  # fmt: skip
    assert plan.base_c == 238.0


def test_arcs_are_deposited_as_arcs(tmp_path: Path) -> None:
    """Half a circle of 10 mm radius from (10, 0) over (0, 10) to (-10, 0), with its filament spread evenly."""
    arcs = CONFIG + "[gcode_arcs]\nresolution: 0.5\n"
    text = "M83\nG1 X10 Y0 F3000\n{} X-10 Y0 I-10 J0 E3.14\n"
    moves = host_moves(tmp_path, text.format("G3"), arcs)[1:]
    places = [move.end_pos for move in moves]
    assert all(math.hypot(x, y) == pytest.approx(10.0, abs=1e-6) for x, y, *_ in places)
    assert sum(move.move_d for move in moves) == pytest.approx(10.0 * math.pi, abs=0.05)
    assert max(y for _, y, *_ in places) == pytest.approx(10.0, abs=0.05)
    assert sum(move.axes_d[3] for move in moves) == pytest.approx(3.14)
    clockwise = offline_plan(tmp_path, text.format("G2"), arcs).moves
    assert min(move.end_mm[1] for move in clockwise) == pytest.approx(-10.0, abs=0.05)
    assert {move.line for move in clockwise} == {2}


def test_a_transform_of_the_config_moves_the_path(tmp_path: Path) -> None:
    skew = CONFIG + "[skew_correction]\n"
    text = "SET_SKEW XY=141,142,100\n" + START + "G1 X40 E1 F1200\nG1 Y40 E1\n"
    plain, skewed = offline_plan(tmp_path, text), offline_plan(tmp_path, text, skew)
    assert ends(plain)[1][:2] == (40.0, 40.0)
    assert abs(ends(skewed)[1][0] - 40.0) > 0.1


def test_factors_and_origins_of_a_file_count(tmp_path: Path) -> None:
    text = "M82\nG92 E0\nM221 S50\nM220 S50\nG1 X40 E4 F3000\nG92 X0\nG1 X10 E6\n"
    first, second = host_moves(tmp_path, text)
    assert first.cruise_v <= 25.0 + 1e-9 and first.axes_d[3] == pytest.approx(2.0)
    assert second.end_pos[0] == pytest.approx(50.0) and second.axes_d[3] == pytest.approx(1.0)


def test_the_fan_and_the_bed_of_the_file_count(tmp_path: Path) -> None:
    """A second layer after 12 s: on a hotter bed it meets a warmer one, under the fan a cooler one."""
    roads = "".join(f"G1 X{40 if n % 2 else 0} E1 F1200\n" for n in range(6))
    text = "M140 S{}\nM106 S{}\n" + START + roads + "G1 Z0.5\n" + roads

    def met_c(bed_c: int, fan: int) -> float:
        moves: list[PlannedMove] = offline_plan(tmp_path, text.format(bed_c, fan), BY_NAME).moves
        return moves[-1].substrate_c

    cold, hot, blown = met_c(40, 0), met_c(100, 0), met_c(100, 255)
    assert hot > cold + 10.0 and blown < hot - 1.5


def test_a_file_writes_nothing_beside_its_plan(tmp_path: Path) -> None:
    """Lines that would end the run, save or print something else do nothing."""
    variables = tmp_path / "variables.cfg"
    section = CONFIG + f"[save_variables]\nfilename: {variables}\n[virtual_sdcard]\npath: {tmp_path}\n"
    text = "SAVE_VARIABLE VARIABLE=a VALUE=1\nSDCARD_PRINT_FILE FILENAME=part.gcode\nSAVE_CONFIG\nRESTART\nM112\n"
    plan = offline_plan(tmp_path, text + LINES, section)
    assert len(plan.moves) == 4 and plan.moves[0].line == 15
    assert {path.name for path in tmp_path.iterdir()} <= {"printer.cfg", "part.gcode", "variables.cfg"}
    assert not variables.exists() or "a = 1" not in variables.read_text()


def test_a_config_of_another_host_is_no_reason_to_refuse_a_file(tmp_path: Path) -> None:
    """A board on a bus that this host does not serve, chips and sections that it does not know."""
    other = (
        "[mcu]\ncanbus_uuid: 11aa22bb33cc\n[sx1509 duex]\ni2c_address: 62\n[output_pin light]\n"
        "pin: sx1509_duex:PIN_1\n[some_plugin]\ncolour: red\n"
    )
    assert len(offline_plan(tmp_path, LINES, CONFIG + other).moves) == 4


def test_a_printer_with_axes_refuses_what_is_out_of_their_reach(tmp_path: Path) -> None:
    root = Path(__file__).resolve().parents[3]
    config = f"[include {root}/config/sim-induction.cfg]\n[temperature_plan]\n"
    with pytest.raises(ValueError, match=r"line 2: 'G1 X300 E1': Move out of range: 300\.000"):
        offline_plan(tmp_path, "M83\nG1 X300 E1\n", config)
