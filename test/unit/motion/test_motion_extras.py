"""Arcs, firmware retraction, homing replacements, extruder steppers: through the printer in batch mode."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from extras.gcode_arcs import PLANES, arc_points
from motion_rig import CONFIG, EXTRUDER, BatchResult, batch


@pytest.fixture
def run(tmp_path: Path):
    def go(gcode: str, more: str = "") -> BatchResult:
        return batch(tmp_path, gcode, CONFIG + EXTRUDER + more)

    return go


@pytest.mark.parametrize("name", PLANES)
@pytest.mark.parametrize("clockwise", [False, True])
def test_arc_points_lie_on_the_circle(name: str, clockwise: bool) -> None:
    plane = PLANES[name]
    start, end = [10.0, 20.0, 30.0], [10.0, 20.0, 30.0]
    end[plane.first] += 10.0
    end[plane.second] += 10.0
    end[plane.helix] += 4.0
    points = arc_points(plane, start, end, (10.0, 0.0), clockwise, 0.5)
    centre = start[plane.first] + 10.0, start[plane.second]
    for point in points:
        radius = math.hypot(point[plane.first] - centre[0], point[plane.second] - centre[1])
        assert radius == pytest.approx(10.0)
    assert points[-1] == end
    # from pi to pi/2: a quarter clockwise, three quarters the other way, in pieces of at least half a mm
    length = 10.0 * (0.5 if clockwise else 1.5) * math.pi
    assert len(points) == math.floor(math.hypot(length, 4.0) / 0.5)


def test_a_full_circle_comes_back(run) -> None:
    gcode = "G28\nG1 X100 Y100 F6000\n{}\nM114\nM400\n"
    outcome = run(gcode.format("G2 X100 Y100 I20 E10 F3000"), "[gcode_arcs]\nresolution: 0.5\n")
    assert outcome.result == "exit", outcome.replies
    assert "X:100.000 Y:100.000 Z:0.500 E:10.000" in outcome.replies
    plain = run(gcode.format("")).traces()["stepper_x"]
    circle = outcome.traces()["stepper_x"]
    assert circle.position == plain.position
    # x goes 40 mm over and back; straight pieces of 0.5 mm miss the outermost point by less than a step
    assert len(circle.clocks) - len(plain.clocks) == pytest.approx(80 * 80, abs=4)


BAD_ARCS = [("G91\nG2 X1 I1", "relative move mode"), ("G2 X1 R3", "R moves"), ("G3 X1", "requires I or J")]


@pytest.mark.parametrize(("line", "text"), BAD_ARCS)
def test_arcs_that_cannot_be_are_refused(run, line: str, text: str) -> None:
    outcome = run("G28\n" + line, "[gcode_arcs]\n")
    assert any(text in r for r in outcome.replies if r.startswith("!!"))


RETRACT = "[firmware_retraction]\nretract_length: 2\nunretract_extra_length: 0.5\n"


def test_retraction_is_done_once_and_undone(run) -> None:
    per_mm = 3200 / 33.5
    down = run("G10\nG10\nM400\n", RETRACT).traces()["extruder"]
    assert down.position == pytest.approx(-2 * per_mm, abs=1)
    up = run("G10\nG11\nG11\nM400\n", RETRACT).traces()["extruder"]
    assert up.position == pytest.approx(0.5 * per_mm, abs=1)


def test_safe_z_home_goes_to_its_place(run) -> None:
    outcome = run("G28\nM114\n", "[safe_z_home]\nhome_xy_position: 50, 60\nz_hop: 7\n")
    assert outcome.result == "exit", outcome.replies
    assert any(r.startswith("X:50.000 Y:60.000 Z:7.000") for r in outcome.replies)


def test_homing_override_runs_its_script_with_the_plain_g28_inside(run) -> None:
    more = "[homing_override]\naxes: z\nset_position_z: 0\ngcode:\n  G1 Z5 F600\n  G28 X Y\n  G28 Z\n  G1 X33 F6000\n"
    outcome = run("G28 Z\nM114\n", more)
    assert outcome.result == "exit", outcome.replies
    assert any(r.startswith("X:33.000 Y:200.000 Z:0.500") for r in outcome.replies)


def test_an_extruder_stepper_follows(run) -> None:
    more = (
        "[extruder_stepper second]\nextruder: extruder\nstep_pin: PE0\ndir_pin: PE1\nmicrosteps: 16\n"
        "rotation_distance: 33.5\n"
    )
    traces = run("G28\nM83\nG1 X50 E3 F3000\nM400\n", more).traces()
    assert traces["extruder_stepper second"].clocks == traces["extruder"].clocks
