"""The real printer in batch mode: G-code in, step commands out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from motion_rig import CLOCK_HZ, CONFIG, EXTRUDER, BatchResult, batch

HOMED = "G28\n"
# Steps from homing at (0, 200, 0.5): 80 steps/mm for x and y, 400 for z.
X_PER_MM, Z_PER_MM = 80, 400


@pytest.fixture
def run(tmp_path: Path):
    def go(gcode: str, config: str = CONFIG + EXTRUDER) -> BatchResult:
        return batch(tmp_path, gcode, config)

    return go


def errors(outcome: BatchResult) -> list[str]:
    return [r for r in outcome.replies if r.startswith("!!")]


def test_a_square_comes_back_to_where_it_began(run) -> None:
    plain = run(HOMED + "G1 X10 Y10 F6000")
    square = run(HOMED + "G1 X10 Y10 F6000\nG1 X50\nG1 Y50\nG1 X10\nG1 Y10\nM400")
    assert plain.result == square.result == "exit"
    for name in ("stepper_x", "stepper_y", "stepper_z"):
        assert plain.traces()[name].position == square.traces()[name].position
    before, after = plain.traces()["stepper_x"], square.traces()["stepper_x"]
    assert len(after.clocks) - len(before.clocks) == 2 * 40 * X_PER_MM


def test_batch_homing_runs_the_whole_way_twice(run) -> None:
    """An endstop counts as triggered at the end of the full move: 1.5 ranges, 5 mm back, 10 mm forth."""
    traces = run("G28 X").traces()
    x = traces["stepper_x"]
    assert x.position == -(300 - 5 + 10) * X_PER_MM
    assert not traces["stepper_y"].clocks
    y = run("G28 Y").traces()["stepper_y"]
    assert y.position == -(300 - 5 + 10) * X_PER_MM  # towards +, with an inverted dir pin
    step_s = np.diff(x.clocks[:20000]) / CLOCK_HZ
    assert np.median(step_s) == pytest.approx(1.0 / (50.0 * X_PER_MM), rel=1e-3)


def test_axis_speeds_and_z_limits_hold(run) -> None:
    traces = run(HOMED + "G1 X100 Y100 Z10 F30000\nG1 X20 Z3\nM400").traces()
    z = traces["stepper_z"]
    # the finest interval is not below that of 10 mm/s by more than the 25 us tolerance allows over ten steps
    ten = (np.array(z.clocks)[10:] - np.array(z.clocks)[:-10]) / CLOCK_HZ
    assert ten.min() >= 10 / (10.0 * Z_PER_MM) - 25e-6


def test_extruder_follows_the_head_in_proportion(run) -> None:
    outcome = run(HOMED + "M83\nG1 X20 F3000\nG1 X120 E5 F3000\nM400")
    e = outcome.traces()["extruder"]
    per_mm = 3200 / 33.5
    assert abs(e.position - 5 * per_mm) <= 1
    middle = np.array(e.clocks)[100:300] / CLOCK_HZ
    assert np.median(np.diff(middle)) == pytest.approx(1 / (50.0 * 0.05 * per_mm), rel=0.01)


def test_a_wider_extrusion_limit_makes_no_faster_retractions(run) -> None:
    """max_extrude_only_velocity and _accel come from 4 nozzle diameters squared, whatever is allowed for lines."""

    def lasts(more: str) -> int:
        clocks = (
            run(HOMED + "M83\nG1 X20 F6000\nG1 E-5 F6000\nM400", CONFIG + EXTRUDER + more)
            .traces()["extruder"]
            .clocks
        )
        return clocks[-1] - clocks[0]

    plain = lasts("")
    assert lasts("max_extrude_cross_section: 5\n") == plain
    assert lasts("max_extrude_only_accel: 100\n") > plain  # the options themselves do count


def test_pressure_advance_pushes_ahead_and_takes_back(run) -> None:
    gcode = HOMED + "SET_PRESSURE_ADVANCE ADVANCE=0.1\nM83\nG1 X20 F6000\nG1 X60 E4 F6000\nM400\n"
    plain = run(gcode.replace("=0.1", "=0")).traces()["extruder"]
    ahead = run(gcode).traces()["extruder"]
    assert plain.position == ahead.position
    # K * e' = 0.1 s * 10 mm/s = 1 mm is taken back while braking feeds another 10/2 mm/s * 33 ms = 0.17 mm;
    # smoothing over +-20 ms of a fall that lasts 33 ms rounds the top by another 0.1 mm or so
    taken_back_mm = (max(ahead.positions) - ahead.position) * 33.5 / 3200
    assert 0.65 < taken_back_mm < 0.84
    assert max(plain.positions) == plain.position


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("G1 Xnan", "X needs a number"),
        ("G1 X10 Einf", "E needs a number"),
        (f"G1 X1{'0' * 400} Y5", "which is not a finite number"),
        ("G1 Y5 X--3", "X is '--3'"),
        ("G1 X10 F0", "F must be above zero"),
        ("G1 X10 F-100", "F must be above zero"),
        ("G1 X500", "Move out of range: 500.000"),
        ("G1 X-0.1", "Move out of range"),
        ("G1 X20 E60", "Move exceeds maximum extrusion"),
        ("G1 E-60", "Extrude only move too long"),
        ("G20", "does not support G20"),
        ("G92 Xnan", "X"),
        ("M220 S-5", "S"),
        ("M204 S0", "S"),
        ("SET_VELOCITY_LIMIT ACCEL=nan", "ACCEL"),
        ("G4 P-1", "P"),
        ("RESTORE_GCODE_STATE NAME=none", "Unknown g-code state"),
    ],
)
def test_a_bad_line_is_refused_and_changes_nothing(run, line: str, text: str) -> None:
    """In batch mode an error ends the run; the state is asked for from the error's event."""
    outcome = run(HOMED + "M83\nG1 X10 Y150 Z5 E1 F3000\n" + line)
    assert outcome.result == "error_exit"
    assert len(errors(outcome)) == 1 and text in errors(outcome)[0]
    move = outcome.printer.lookup_object("gcode_move")
    assert move.get_gcode_position() == pytest.approx((10.0, 150.0, 5.0, 1.0))
    status = move.get_status()
    assert status["speed"] == 50.0 and status["speed_factor"] == 1.0
    toolhead = outcome.printer.lookup_object("toolhead")
    assert toolhead.get_position() == pytest.approx([10.0, 150.0, 5.0, 1.0])
    assert toolhead.get_max_velocity() == (300.0, 3000.0)


def test_moving_before_homing_is_refused(run) -> None:
    outcome = run("G1 X10 F3000")
    assert outcome.result == "error_exit"
    assert "Must home axis first: 10.000" in errors(outcome)[0]


def test_m84_forgets_the_position(run) -> None:
    outcome = run(HOMED + "M84\nG1 X10 F3000")
    assert "Must home axis first" in errors(outcome)[0]


FORCED = "[force_move]\nenable_force_move: True\n"
COLD_MOVE = "SET_KINEMATIC_POSITION X=100 Y=100 Z=10\nG1 X{} F6000\n{}G4 P3000\nG1 X100\nM400"


@pytest.mark.parametrize("x", [101.0, 100.02, 140.0])
def test_m84_switches_off_a_motor_whose_first_steps_are_only_queued(run, x: float) -> None:
    """Nobody has waited for the move when M84 is read; the motor is on by then for no one but the plan."""
    config = CONFIG + EXTRUDER + FORCED
    outcome = run(COLD_MOVE.format(x, f"M84\nSET_KINEMATIC_POSITION X={x} Y=100 Z=10\n"), config)
    assert outcome.result == "exit", outcome.replies
    moved = outcome.traces()["stepper_x"]
    way = round((x - 100.0) * X_PER_MM)
    first, last, again = moved.clocks[0], moved.clocks[way - 1], moved.clocks[way]
    lines = [(p["clock"], p["on_ticks"] == 0) for p in outcome.commands if p["#name"] == "queue_digital_out"]
    before = [on for clock, on in lines if clock <= first]
    rest = [(clock, on) for clock, on in lines if last < clock < again]
    assert before[-1] is True, "on before its first step"
    assert [on for _, on in rest] == [False, True], "off at M84, on for the next move"
    assert (rest[0][0] - last) / CLOCK_HZ == pytest.approx(0.1, abs=0.01)  # the rest before switching off
    undisturbed = run(COLD_MOVE.format(x, ""), config).traces()["stepper_x"]
    assert np.ptp(np.array(moved.clocks[:way]) - undisturbed.clocks[:way]) <= 2 * 25e-6 * CLOCK_HZ
    assert moved.position == undisturbed.position == 0


def test_extrusion_without_an_extruder_is_refused(run) -> None:
    outcome = run(HOMED + "G1 X10 E1 F3000", CONFIG)
    assert "Extrude when no extruder present" in errors(outcome)[0]


def test_motors_are_enabled_before_their_first_step(run) -> None:
    outcome = run("G28 X")
    enables = [p for p in outcome.commands if p["#name"] == "queue_digital_out"]
    first_step = outcome.traces()["stepper_x"].clocks[0]
    # !PA2: low is on
    assert enables[0]["on_ticks"] == 0 and 0 < first_step - enables[0]["clock"] < 0.1 * CLOCK_HZ
    assert enables[-1]["on_ticks"] == 1  # the end of the run switches off
    assert enables[-1]["clock"] > outcome.traces()["stepper_x"].clocks[-1]


POSITIONS = [
    ("G1 X10 Y20 Z3\nG91\nG1 X5 Y-5\nG90", (15, 15, 3, 0)),
    ("G1 X10\nG92 X0\nG1 X5", (5, 200, 0.5, 0)),
    ("M83\nG1 X10 E1\nG1 X20 E1\nM82\nG1 X30 E3", (30, 200, 0.5, 3)),
    ("G1 X10 E2\nG92 E0\nG1 X20 E1", (20, 200, 0.5, 1)),
    ("SET_GCODE_OFFSET X=1 Z=0.5\nG1 X10 Z1", (10, 200, 1, 0)),
    ("SAVE_GCODE_STATE NAME=a\nG91\nG1 X7 E1\nRESTORE_GCODE_STATE NAME=a MOVE=1", (0, 200, 0.5, 0)),
    ("M221 S50\nG1 X10 E2\nM221 S100", (10, 200, 0.5, 2)),
]


@pytest.mark.parametrize(("gcode", "position"), POSITIONS)
def test_gcode_position_follows_the_modes(run, gcode: str, position: tuple[float, ...]) -> None:
    outcome = run(f"{HOMED}G1 F6000\n{gcode}\nM114")
    assert outcome.result == "exit", outcome.replies
    wanted = "X:{:.3f} Y:{:.3f} Z:{:.3f} E:{:.3f}".format(*position)
    assert wanted in outcome.replies


def test_offsets_move_the_machine(run) -> None:
    plain = run(HOMED + "G1 X10 F6000").traces()["stepper_x"].position
    shifted = run(HOMED + "SET_GCODE_OFFSET X=1\nG1 X10 F6000").traces()["stepper_x"].position
    assert shifted - plain == X_PER_MM


def test_speed_factor_changes_time_only(run) -> None:
    gcode = HOMED + "G1 X10 F3000\n{}G1 X110\nM400"
    full, half = (run(gcode.format(s)).traces()["stepper_x"] for s in ("", "M220 S50\n"))
    assert full.position == half.position

    def duration(clocks: list[int]) -> float:
        return (clocks[-1] - clocks[-100 * X_PER_MM]) / CLOCK_HZ

    assert duration(half.clocks) == pytest.approx(2.0 * duration(full.clocks), rel=0.02)


def test_dwell_puts_a_gap_between_moves(run) -> None:
    clocks = run(HOMED + "G1 X10 F6000\nG4 P1500\nG1 X20\nM400").traces()["stepper_x"].clocks
    gap_s = (clocks[-10 * X_PER_MM] - clocks[-10 * X_PER_MM - 1]) / CLOCK_HZ
    assert gap_s == pytest.approx(1.5, abs=0.02)  # plus the first and last step of the ramps


def test_buzz_ends_where_it_began(run) -> None:
    trace = run("STEPPER_BUZZ STEPPER=stepper_y").traces()["stepper_y"]
    assert trace.position == 0
    assert len(trace.clocks) == 20 * X_PER_MM  # ten times 1 mm forth and back


def test_a_second_mcu_gets_its_own_stream(tmp_path: Path) -> None:
    config = CONFIG.replace("step_pin: PC0", "step_pin: zed:PC0").replace("dir_pin: PC1", "dir_pin: zed:PC1")
    config = config.replace("[printer]", "[mcu zed]\nserial: /dev/null\n[printer]")
    (tmp_path / "dict").write_bytes(b"")
    outcome = batch(tmp_path, HOMED + "G1 X10 Z5 F600", config, dictionary_zed=str(tmp_path / "dict"))
    assert outcome.result == "exit", (outcome.message, outcome.replies)
    assert (tmp_path / "out-zed").stat().st_size > 1000
    names = {p["oid"] for p in outcome.commands if p["#name"] == "queue_step"}
    assert len(names) == 2  # x and y only
