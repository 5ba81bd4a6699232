"""[bed_mesh] and the short way of G1 lines: it is taken while there is no mesh, and left while there is one."""

from __future__ import annotations

import random

from test_motion_fast import HOMED, MACHINE, run  # noqa: F401 (a fixture)

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


def moves(count: int) -> str:
    rng = random.Random(4)
    return "".join(f"G1 X{rng.uniform(10, 90):.2f} Y{rng.uniform(10, 90):.2f} E0.1\n" for _ in range(count))


def test_without_a_mesh_the_section_changes_nothing(run) -> None:  # noqa: F811
    plain = run(HOMED + moves(200), True)
    section = run(HOMED + moves(200), True, MACHINE + MESH)
    assert section.out == plain.out and section.row_lines == plain.row_lines > 190


def test_with_a_mesh_every_move_goes_by_it(run) -> None:  # noqa: F811
    gcode = HOMED + "BED_MESH_PROFILE LOAD=ramp\n" + moves(100)
    short = run(gcode, True, MACHINE + MESH)
    long = run(gcode, False, MACHINE + MESH)
    assert short.out == long.out and short.position == long.position
    assert short.out != run(HOMED + moves(100), True, MACHINE + MESH).out
    assert short.row_lines <= HOMED.count("G1")


def test_after_the_mesh_the_short_way_is_taken_again(run) -> None:  # noqa: F811
    gcode = HOMED + "BED_MESH_PROFILE LOAD=ramp\n" + moves(50) + "BED_MESH_CLEAR\nG1 Z0.3\n" + moves(100)
    short = run(gcode, True, MACHINE + MESH)
    long = run(gcode, False, MACHINE + MESH)
    assert short.out == long.out and short.gcode_state == long.gcode_state
    assert short.row_lines > 95
