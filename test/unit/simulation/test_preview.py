"""What simulate.py says of a file before it is printed: only what is certain."""

from __future__ import annotations

from pathlib import Path

import pytest

from simulation.preview import Machine, objection

KNOWN = frozenset(
    (
        *(
            "G0",
            "G1",
            "G2",
            "G4",
            "G28",
            "G90",
            "G91",
            "G92",
            "M83",
            "M104",
            "M109",
            "M190",
            "M220",
            "T0",
            "T1",
        ),
        *(
            "START_PRINT",
            "SET_GCODE_OFFSET",
            "SAVE_GCODE_STATE",
            "RESTORE_GCODE_STATE",
            "SET_PRESSURE_ADVANCE",
        ),
        "SET_DUAL_CARRIAGE",
    )
)
BED = {"X": (0.0, 180.0), "Y": (-3.0, 180.0), "Z": (0.0, 180.0)}


def problem(
    tmp_path: Path, text: str, macros: frozenset[str] = frozenset(), bed: object = None
) -> str | None:
    path = tmp_path / "part.gcode"
    path.write_text(text)
    ranges = BED if bed is None else bed
    assert isinstance(ranges, dict)
    return objection(path, Machine(KNOWN.__contains__, macros, ranges))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("G28\nG1 X180.1 F6000\n", "line 2: 'G1 X180.1 F6000' is out of range: X 180.1"),
        ("G28\nG1 X10 Y-3.5\n", "Y -3.5, the printer's Y goes from -3 to 180 mm"),
        ("G28\ng1x5 z200 ; up\n", "Z 200"),
        ("N1 G28*18\nN2 G1 X500*100\n", "X 500"),
        ("M201 X9000\nM862.3 P MINI\nM109 S250\nT0\nG28\nG0 X-1\n", "X -1"),  # unknown ones are passed over
        ("G28\nG1 X170\nG91\nG1 X9\nG1 X9\n", "line 5: 'G1 X9' is out of range: X 188"),
        ("G28\nG1 X100\nG92 X0\nG1 X81\n", "X 181"),
        ("G28\nG92 E0\nG2 X200 Y20 I90\n", "X 200"),
        ("G28\nSET_PRESSURE_ADVANCE ADVANCE=0.1\nM220 S50\nG1 X200\n", "X 200"),
    ],
)
def test_a_plain_move_out_of_the_axes_is_found(tmp_path: Path, text: str, words: str) -> None:
    assert words in (problem(tmp_path, text) or "")


@pytest.mark.parametrize(
    "text",
    [
        "G28\nG1 X180 Y-3 Z0\n",
        "START_PRINT\nG1 X500\n",
        "G28\nM109 S250\nG1 X500\n",  # M109 is a macro below
        "G28\nSET_GCODE_OFFSET X=-400\nG1 X500\n",
        "G28\nRESTORE_GCODE_STATE NAME=moved\nG1 X500\n",
        "G28\nT1\nG1 X500\n",
        "G28\nSET_DUAL_CARRIAGE CARRIAGE=1\nG1 X500\n",
        "G92 X100\nG1 X500\n",  # where that puts the origin is not known
        "G28\nG1 X100\nG92 X400\nG1 X450\n",
        "G28\nG1 X100\nG92\nG1 X-50\n",
        "G28\nG1 Y100\nG92 Y0\nG28 X\nG1 X50 Y200\n",
        "G28\nG91\nG1 X500\n",  # from where homing has ended
        "G28\nG1 X170\nG91\nG1 X5\nG1 X-5\nG1 X9\n",
        "G28\nG1 X10 E500 F99999\n",
        "G28\n; G1 X500\nM117 G1 X500\n",
        "G28\nG1 Xabc\nG1 X500\n",  # the printer says what is wrong with line 2
    ],
)
def test_what_is_not_certain_is_no_problem(tmp_path: Path, text: str) -> None:
    assert problem(tmp_path, text, macros=frozenset(("START_PRINT", "M109"))) is None


def test_a_machine_without_ranges_takes_every_move(tmp_path: Path) -> None:
    assert problem(tmp_path, "G28\nG1 X500\n", bed={}) is None


@pytest.mark.parametrize("text", ["M9876\n", "START_PRINT\n", "; head\n\nM84\n", "T7\n"])
def test_one_command_makes_a_file_g_code(tmp_path: Path, text: str) -> None:
    assert problem(tmp_path, text) is None


@pytest.mark.parametrize(
    "text", ["", "; a remark\n", "root:x:0:0:root\n", "Dear reader,\n\nthis is a letter.\n"]
)
def test_a_file_without_any_command_is_no_g_code(tmp_path: Path, text: str) -> None:
    assert problem(tmp_path, text) == "part.gcode is not G-code: no line of it is a command"
