"""Transforms between G-code and toolhead, and G1 in rows: what comes out is what they give line by line."""

from __future__ import annotations

import random
from typing import Any

import pytest
from test_motion_fast import HOMED, MACHINE, both, run  # noqa: F401 (a fixture)

MESH = """
[bed_mesh]
mesh_min: 0, 0
mesh_max: 100, 100
[bed_mesh ramp]
version: 1
points:
  0, 0.1, 0.2
  0, 0.1, 0.2
  0, 0.1, 0.3
x_count: 3
y_count: 3
mesh_x_pps: 2
mesh_y_pps: 2
algo: lagrange
tension: 0.2
min_x: 0
max_x: 100
min_y: 0
max_y: 100
"""


TRANSFORMS = MACHINE + MESH + "[skew_correction]\n[exclude_object]\n"
LOAD = "BED_MESH_PROFILE LOAD=ramp\n"
SKEW = "SET_SKEW XY=141.6,141.2,100 YZ=141.2,141.5,100\n"


def moves(count: int, spread_mm: float = 0.5) -> str:
    """Short lines near each other, some of them without filament."""
    rng = random.Random(4)
    x, y, text = 50.0, 50.0, []
    for number in range(count):
        x = min(90.0, max(10.0, x + rng.gauss(0.0, spread_mm)))
        y = min(90.0, max(10.0, y + rng.gauss(0.0, spread_mm)))
        text.append(f"G1 X{x:.3f} Y{y:.3f}" + " E0.02\n" * (number % 5 != 0) + "\n" * (number % 5 == 0))
    return "".join(text)


def test_without_a_mesh_the_section_changes_nothing(run) -> None:  # noqa: F811
    plain = run(HOMED + moves(200), True)
    section = run(HOMED + moves(200), True, MACHINE + MESH)
    assert section.out == plain.out and section.row_lines == plain.row_lines > 190


@pytest.mark.parametrize(
    "setup",
    [LOAD, SKEW, "EXCLUDE_OBJECT_START NAME=a\n", LOAD + SKEW + "EXCLUDE_OBJECT_START NAME=a\n"],
    ids=["mesh", "skew", "object", "all"],
)
@pytest.mark.parametrize("spread_mm", [0.5, 20.0])
def test_transforms_in_rows_do_what_they_do_line_by_line(run, setup: str, spread_mm: float) -> None:  # noqa: F811
    gcode = HOMED + setup + "G1 Z0.4\n" + moves(200, spread_mm) + "M400\nG1 X50 Y50\n" + moves(50, spread_mm)
    outcome = both(run, gcode, config=TRANSFORMS)
    if "LOAD" in setup or "SKEW" in setup:
        assert outcome.out != run(HOMED + "G1 Z0.4\n" + moves(200, spread_mm), True, TRANSFORMS).out
    # a long line over a mesh has several corners, between which it may be time to plan
    assert outcome.row_lines > (220 if spread_mm < 1.0 else 60)


def test_a_print_goes_on_in_rows_after_an_excluded_object(run) -> None:  # noqa: F811
    gcode = (
        HOMED + "EXCLUDE_OBJECT_START NAME=a\n" + moves(50) + "G1 E-0.8\nEXCLUDE_OBJECT NAME=a\n" + moves(20)
        + "EXCLUDE_OBJECT_END\n" + "G1 X20 Y20\nG1 E0.8\n" + moves(100)
    )  # fmt: skip
    outcome = both(run, gcode, config=TRANSFORMS)
    assert 50 + 95 < outcome.row_lines < 50 + 20 + 100


def test_a_line_refused_at_its_end_comes_out_the_same(run) -> None:  # noqa: F811
    """Its first corners over the mesh are inside."""
    outcome = both(run, HOMED + LOAD + moves(40) + "G1 X201 Y90 E0.1\n", config=TRANSFORMS)
    assert any("Move out of range" in warning for warning in outcome.warnings)


def test_another_move_of_a_transform_is_called(run) -> None:  # noqa: F811
    seen: list[float] = []

    def put_in_place(printer: Any) -> None:
        mesh = printer.lookup_object("bed_mesh")
        own = mesh.move
        mesh.move = lambda newpos, speed: (seen.append(newpos[0]), own(newpos, speed))
        printer.lookup_object("gcode_move").set_move_transform(mesh, force=True)

    outcome = run(HOMED + LOAD + moves(20), True, MACHINE + MESH, put_in_place)
    assert len(seen) == 21 and outcome.row_lines == 0


def test_after_the_mesh_moves_are_as_without_one(run) -> None:  # noqa: F811
    gcode = HOMED + LOAD + moves(50) + "BED_MESH_CLEAR\nG1 Z0.3\n" + moves(100)
    assert both(run, gcode, config=MACHINE + MESH).row_lines > 140
