"""Every .test file here, and the runner itself: it must see what is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from test_klippy import TestError, read_cases, run_case, run_file

FOLDER = Path(__file__).resolve().parent
FILES = sorted(path.relative_to(FOLDER).as_posix() for path in FOLDER.rglob("*.test"))


@pytest.mark.parametrize("name", FILES)
def test_file(name: str) -> None:
    wrong = run_file(FOLDER / name)
    assert not wrong, "\n".join(wrong)


def wrongs(tmp_path: Path, lines: str, config: str = "../../config/example-cartesian.cfg") -> list[str]:
    path = tmp_path / "t.test"
    path.write_text(f"DICTIONARY ferrite.dict\nCONFIG {FOLDER / config}\n{lines}\n")
    (case,) = read_cases(path)
    return run_case(case)


@pytest.mark.parametrize(
    ("lines", "text"),
    [
        ("G28\nEXPECT steps stepper_x: 1", "made"),
        ("G28\nEXPECT steps stepper_x: 25200 net 25200", "net -24400"),
        ("G28\nEXPECT position X=1", "the toolhead is at"),
        ("G28\nEXPECT response nobody says this", "answers"),
        ("M114\nEXPECT no_response X:", "no_response"),
        ("G1 X10", "it failed"),
        ("SHOULD_FAIL\nG28", "it did not fail"),
        ("SHOULD_FAIL\nG1 X10\nEXPECT error out of range", "errors: "),
        ("M104 S200\nEXPECT temperature extruder: 200", "[200.0, 0.0]"),
        ("G28\nREFUSED G1 X10 => out of range", "was not refused"),
        ("G28\nREFUSED G1 X500 => another reason", "was refused with"),
        ("G28 X\nEXPECT duration stepper_x: 1.0", "steps for"),
    ],
)
def test_the_runner_sees_what_is_wrong(tmp_path: Path, lines: str, text: str) -> None:
    found = wrongs(tmp_path, lines)
    assert len(found) == 1 and text in found[0], found


@pytest.mark.parametrize(
    "lines", ["EXPECT nonsense 1", "OPTION stepper_x position_max 1", "REFUSED G1 X1", "GCODE no-such-file"]
)
def test_malformed_lines_are_named(tmp_path: Path, lines: str) -> None:
    with pytest.raises(TestError, match=r"t\.test:3: "):
        wrongs(tmp_path, lines)
