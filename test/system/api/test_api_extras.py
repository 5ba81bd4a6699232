"""Print control around the toolhead: excluded objects, tuning towers, delayed G-code, heaters off while homing."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from base_rig import Session, start_error


class FakeToolhead:
    """Takes moves and remembers them."""

    def __init__(self) -> None:
        self.position = [0.0, 0.0, 0.0, 0.0]
        self.moves: list[tuple[float, ...]] = []

    def get_position(self) -> list[float]:
        return list(self.position)

    def move(self, newpos: Any, speed: float) -> None:
        self.position = list(newpos)
        self.moves.append(tuple(round(value, 6) for value in newpos))

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {"print_time": 0.0, "estimated_print_time": 0.0}

    def get_last_move_time(self) -> float:
        return 0.0

    def wait_moves(self) -> None:
        pass

    def dwell(self, delay: float) -> None:
        pass


def session(tmp_path: Path, config: str) -> tuple[Session, FakeToolhead]:
    made = Session(tmp_path, config)
    toolhead = FakeToolhead()
    made.printer.add_object("toolhead", toolhead)
    return made, toolhead


def run(tmp_path: Path, config: str, script: str) -> tuple[Session, FakeToolhead]:
    made, toolhead = session(tmp_path, config)
    made.run(lambda s: s.gcode.run_script(script))
    return made, toolhead


# --- exclude_object ---
OBJECTS = """EXCLUDE_OBJECT_DEFINE NAME=a CENTER=10,10 POLYGON=[[5,5],[15,5],[15,15]]
EXCLUDE_OBJECT_DEFINE NAME=b CENTER=50,50
M83
"""


def test_objects_are_known_by_what_the_slicer_defines(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.gcode.run_script(OBJECTS + "EXCLUDE_OBJECT_DEFINE NAME=c MATERIAL=PLA\nEXCLUDE_OBJECT_START NAME=b")
        status = s.status("exclude_object")
        assert status["objects"] == [
            {"name": "A", "center": [10, 10], "polygon": [[5, 5], [15, 5], [15, 15]]},
            {"name": "B", "center": [50, 50]},
            {"name": "C", "material": "PLA"},
        ]
        assert (status["excluded_objects"], status["current_object"]) == ([], "B")
        s.gcode.run_script("EXCLUDE_OBJECT CURRENT=1\nEXCLUDE_OBJECT NAME=a\nEXCLUDE_OBJECT_END NAME=b")
        status = s.status("exclude_object")
        assert (status["excluded_objects"], status["current_object"]) == (["A", "B"], None)
        with pytest.raises(s.gcode.error, match="no current object"):
            s.gcode.run_script("EXCLUDE_OBJECT CURRENT=1")
        s.gcode.run_script("EXCLUDE_OBJECT NAME=a RESET=1")
        assert s.status("exclude_object")["excluded_objects"] == ["B"]
        s.printer.send_event("virtual_sdcard:reset_file")
        assert s.status("exclude_object") == {"objects": [], "excluded_objects": [], "current_object": None}

    session(tmp_path, "[exclude_object]\n")[0].run(body)


@pytest.mark.parametrize("bad", ["CENTER=1,x", "POLYGON=[[1,2],3]", "POLYGON=[[true,2]]", "CENTER=[1"])
def test_shapes_that_are_none_are_refused(tmp_path: Path, bad: str) -> None:
    def body(s: Session) -> None:
        with pytest.raises(s.gcode.error, match="expected CENTER"):
            s.gcode.run_script(f"EXCLUDE_OBJECT_DEFINE NAME=a {bad}")

    session(tmp_path, "[exclude_object]\n")[0].run(body)


def test_moves_of_an_excluded_object_are_left_out(tmp_path: Path) -> None:
    _, toolhead = run(
        tmp_path,
        "[exclude_object]\n",
        OBJECTS
        + "EXCLUDE_OBJECT NAME=a\n"
        + "G1 X1 Y1 E1\nEXCLUDE_OBJECT_START NAME=a\nG1 X10 Y10\nG1 X20 E3\nEXCLUDE_OBJECT_END NAME=a\n"
        + "EXCLUDE_OBJECT_START NAME=b\nG1 X50 Y50\nG1 X60 E2\nEXCLUDE_OBJECT_END NAME=b\n",
    )
    # filament: 1 mm, then 2 mm; the 3 mm of the excluded object are not pushed later either
    assert toolhead.moves == [(1, 1, 0, 1), (50, 50, 0, 1), (60, 50, 0, 3)]


@pytest.mark.parametrize(
    ("inside", "moves_after", "why"),
    [
        # the object's last command draws back 2 mm: the nozzle must be drawn back before the travel
        ("G1 X20 E3\nG1 E-2", [(0, 0, 0, -1), (50, 50, 0, -1), (50, 50, 0, 1)], "retracted inside"),
        # retracted and primed inside: nothing to even out
        ("G1 E-2\nG1 E2\nG1 X20 E3", [(50, 50, 0, 1), (50, 50, 0, 3)], "balanced"),
    ],
)
def test_retractions_inside_an_excluded_object_are_evened_out(
    tmp_path: Path, inside: str, moves_after: list[tuple[float, ...]], why: str
) -> None:
    _, toolhead = run(
        tmp_path,
        "[exclude_object]\n",
        OBJECTS
        + "G1 E1\nEXCLUDE_OBJECT NAME=a\nEXCLUDE_OBJECT_START NAME=a\n"
        + inside
        + "\nEXCLUDE_OBJECT_END\nG1 X50 Y50\nG1 E2\n",
    )
    assert toolhead.moves[0] == (0, 0, 0, 1)
    assert toolhead.moves[1:] == moves_after, why


def test_a_prime_that_was_left_out_is_made_up_for_before_the_next_extrusion(tmp_path: Path) -> None:
    _, toolhead = run(
        tmp_path,
        "[exclude_object]\n",
        OBJECTS
        + "G1 E3\nG1 E-2\nEXCLUDE_OBJECT NAME=a\nEXCLUDE_OBJECT_START NAME=a\nG1 E2\nG1 X20 E5\n"
        + "EXCLUDE_OBJECT_END\nG1 X50 Y50\nG1 X60 E1\n",
    )
    # travel drawn back (E 1), prime to 3, then print 1 mm
    assert toolhead.moves[2:] == [(50, 50, 0, 1), (50, 50, 0, 3), (60, 50, 0, 4)]


# --- tuning_tower ---
def values(made: Session) -> list[float]:
    return [float(line.split("=")[1]) for line in made.lines if line.startswith("echo: V=")]


TOWER = "[gcode_macro SETV]\ngcode: RESPOND MSG='V={params.V}'\n[respond]\n[tuning_tower]\n[exclude_object]\n"


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("START=1 FACTOR=2", [1.4, 2.4, 3.4]),
        ("START=1 FACTOR=2 SKIP=1", [1.0, 1.4]),
        ("START=0 FACTOR=1 BAND=1", [0.5, 1.5]),
        # floor(0.2 / 0.7) is 0, floor(0.7 / 0.7) and floor(1.2 / 0.7) are 1
        ("START=5 STEP_DELTA=-1 STEP_HEIGHT=0.7", [5.0, 4.0]),
    ],
)
def test_a_tower_sets_its_parameter_by_height(tmp_path: Path, options: str, expected: list[float]) -> None:
    made, toolhead = run(
        tmp_path,
        TOWER,
        f"TUNING_TOWER COMMAND=SETV PARAMETER=V {options}\nM83\n"
        "G1 Z0.2\nG1 X1 E1\nG1 X2 E1\nG1 Z9\nG1 Z0.7\nG1 X1 E1\nG1 Z1.2\nG1 X0 E1\n",
    )
    assert values(made) == pytest.approx(expected)
    assert len(toolhead.moves) == 8, "the moves themselves pass unchanged"


def test_a_tower_ends_when_a_new_print_begins_lower(tmp_path: Path) -> None:
    made, _ = run(
        tmp_path,
        TOWER,
        "TUNING_TOWER COMMAND=SETV PARAMETER=V START=0 FACTOR=1\nM83\n"
        "G1 Z5\nG1 X1 E1\nG1 Z0.2\nG1 X2 E1\nG1 Z1\nG1 X1 E1\n",
    )
    assert values(made) == [5.0]
    assert "// Ending tuning test mode" in made.lines


def test_a_tower_needs_one_law(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        for options in ("FACTOR=1 STEP_DELTA=1 STEP_HEIGHT=1", "STEP_DELTA=1", "STEP_HEIGHT=1"):
            with pytest.raises(s.gcode.error, match="TUNING_TOWER"):
                s.gcode.run_script(f"TUNING_TOWER COMMAND=SETV PARAMETER=V {options}")

    session(tmp_path, TOWER)[0].run(body)


# --- delayed_gcode ---
DELAYED = """
[respond]
[gcode_macro COUNT]
variable_n: 0
gcode: SET_GCODE_VARIABLE MACRO=COUNT VARIABLE=n VALUE={n + 1}
[delayed_gcode once]
initial_duration: 2
gcode: RESPOND MSG=once
[delayed_gcode again]
gcode:
  COUNT
  UPDATE_DELAYED_GCODE ID=again DURATION=1
[delayed_gcode broken]
gcode: {action_raise_error("broken on purpose")}
"""


def test_delayed_gcode_runs_once_or_repeats_itself(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.sleep(1.5)
        assert "echo: once" not in s.lines
        s.sleep(10.0)
        assert s.lines.count("echo: once") == 1
        s.gcode.run_script("UPDATE_DELAYED_GCODE ID=again DURATION=1")
        s.sleep(4.5)
        assert s.status("gcode_macro COUNT")["n"] == 4
        s.gcode.run_script("UPDATE_DELAYED_GCODE ID=again DURATION=0")
        s.sleep(5.0)
        assert s.status("gcode_macro COUNT")["n"] == 4
        s.gcode.run_script("UPDATE_DELAYED_GCODE ID=broken DURATION=1")
        s.sleep(2.0)
        assert s.state[1] == "ready", "an error of a delayed script is only reported"
        with pytest.raises(s.gcode.error, match="not valid for ID"):
            s.gcode.run_script("UPDATE_DELAYED_GCODE ID=nobody DURATION=1")

    Session(tmp_path, DELAYED).run(body)


def test_delayed_gcode_needs_a_duration_that_is_none(tmp_path: Path) -> None:
    assert "initial_duration" in start_error(
        tmp_path, "[delayed_gcode x]\ninitial_duration: -1\ngcode: M117\n"
    )


# --- homing_heaters ---
class FakeHeater:
    def __init__(self, target_c: float) -> None:
        self.target_c = target_c

    def get_temp(self, eventtime: float) -> tuple[float, float]:
        return 20.0, self.target_c

    def set_temp(self, target_c: float) -> None:
        self.target_c = target_c


@pytest.mark.parametrize(("stepper", "off"), [("stepper_z", True), ("stepper_x", False)])
def test_heaters_rest_while_their_steppers_home(tmp_path: Path, stepper: str, off: bool) -> None:
    heaters = {"extruder": FakeHeater(200.0), "heater_bed": FakeHeater(60.0)}
    made, toolhead = session(tmp_path, "[homing_heaters]\nsteppers: stepper_z\nheaters: extruder\n")
    made.printer.add_object(
        "heaters",
        SimpleNamespace(get_all_heaters=lambda: list(heaters), lookup_heater=lambda name: heaters[name]),
    )
    named = [SimpleNamespace(get_name=lambda name=name: name) for name in ("stepper_x", "stepper_z")]
    toolhead.get_kinematics = lambda: SimpleNamespace(get_steppers=lambda: named)  # type: ignore[attr-defined]
    moving = [one for one in named if one.get_name() == stepper]
    move = SimpleNamespace(get_mcu_endstops=lambda: [SimpleNamespace(get_steppers=lambda: moving)])

    def body(s: Session) -> None:
        s.printer.send_event("homing:homing_move_begin", move)
        assert heaters["extruder"].target_c == (0.0 if off else 200.0)
        assert heaters["heater_bed"].target_c == 60.0
        s.printer.send_event("homing:homing_move_end", move)
        assert heaters["extruder"].target_c == 200.0

    made.run(body)
