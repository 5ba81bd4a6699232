"""Whole machines: random moves in, step commands out, and back to the path by the machine's own geometry.

For every kinematics the decoded steps give the motors' places at any time, and those the head's: it must run along the
straight lines between the points of the G-code, through every one of them, and no faster than allowed.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import motion_lists
from motion_rig import CLOCK_HZ, BatchResult, batch

CONFIGS = Path(__file__).resolve().parents[3] / "config"
SAMPLE_S = 0.004
# half a step of the motors (0.0125 mm, or 0.07 mm at the rim of a polar bed), stretched by slanted arms a few times
NEAR_MM = 0.06
SPEED_MM_S = 150.0
BOXES = {**motion_lists.BOXES, "polar": ((30, 30, 1), (150, 150, 60))}  # off the centre, on one side of it


def random_points(name: str, seed: int, count: int = 25) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low, high = BOXES[name]
    return np.round(rng.uniform(low, high, (count, 3)), 3)


def gcode_of(points: np.ndarray) -> str:
    lines = [f"G1 X{x:.3f} Y{y:.3f} Z{z:.3f} F{SPEED_MM_S * 60:.0f}" for x, y, z in points]
    return "\n".join(lines) + "\n"


def motor_places(outcome: BatchResult, times: np.ndarray) -> dict[str, np.ndarray]:
    """mm (rad) of each motor of the kinematics at print times, from its step commands."""
    traces = outcome.traces()
    places = {}
    for motor in outcome.printer.lookup_object("toolhead").get_kinematics().get_steppers():
        trace = traces[motor.get_name()]
        sign = -1 if motor.is_dir_inverted() else 1
        done = np.searchsorted(np.array(trace.clocks) / CLOCK_HZ, times, side="right")
        counted = np.concatenate([[0], trace.positions])[done]
        places[motor.get_name()] = (
            motor.get_commanded_position() + sign * (counted - trace.position) * motor.get_step_dist()
        )
    return places


def head_path(outcome: BatchResult, times: np.ndarray) -> np.ndarray:
    places = motor_places(outcome, times)
    kin = outcome.printer.lookup_object("toolhead").get_kinematics()
    return np.array(
        [kin.calc_position({name: float(p[i]) for name, p in places.items()}) for i in range(len(times))]
    )


def distance_to_polyline(path: np.ndarray, points: np.ndarray) -> np.ndarray:
    start, way = points[:-1], np.diff(points, axis=0)
    lengths2 = np.maximum((way**2).sum(axis=1), 1e-12)
    offset = path[:, None, :] - start[None]
    share = np.clip((offset * way[None]).sum(axis=2) / lengths2, 0.0, 1.0)
    return np.linalg.norm(offset - share[..., None] * way[None], axis=2).min(axis=1)


@pytest.mark.parametrize("name", BOXES)
@pytest.mark.parametrize("seed", [1, 2])
def test_the_steps_draw_the_path_of_the_gcode(tmp_path: Path, name: str, seed: int) -> None:
    points = random_points(name, seed)
    config = (CONFIGS / f"example-{name}.cfg").read_text()
    # no faster in z than the motor's share allows, but fast enough for a short test
    config = re.sub(r"(?m)^max_z_velocity:.*", "max_z_velocity: 100", config)
    config = re.sub(r"(?m)^max_z_accel:.*", "max_z_accel: 3000", config)
    run = batch(tmp_path, f"G28\n{gcode_of(points[:1])}M400\n{gcode_of(points[1:])}M400\n", config)
    assert run.result == "exit", (run.message, run.replies)
    clocks = [trace.clocks for trace in run.traces().values() if trace.clocks]
    end = max(c[-1] for c in clocks) / CLOCK_HZ
    # nothing in the file says when homing ended: walk back from the end by more than the moves can take (some machines
    # slow down at their rim)
    ways = np.linalg.norm(np.diff(points, axis=0), axis=1)
    begin = end - 2.0 * (ways.sum() / SPEED_MM_S + len(ways) * 2 * SPEED_MM_S / 3000.0)
    times = np.arange(begin, end + SAMPLE_S, SAMPLE_S)
    path = head_path(run, times)
    first = np.linalg.norm(path - points[0], axis=1).argmin()
    times, path = times[first:], path[first:]
    assert distance_to_polyline(path, points).max() < NEAR_MM
    # every point is passed, in order: at a corner the head is slow, so a sample lies close to it
    at = 0
    for point in points:
        near = np.flatnonzero(np.linalg.norm(path[at:] - point, axis=1) < NEAR_MM + SPEED_MM_S * SAMPLE_S)
        assert len(near), f"{name} does not pass {point}"
        at += int(near[0])
    assert np.linalg.norm(path[-1] - points[-1]) < NEAR_MM
    # over 40 ms the rounding of both ends to steps is below 4 mm/s
    speeds = np.linalg.norm(path[10:] - path[:-10], axis=1) / (10 * SAMPLE_S)
    assert speeds.max() < SPEED_MM_S + 2 * NEAR_MM / (10 * SAMPLE_S)
    assert speeds.max() > 0.5 * SPEED_MM_S


IDEX = (CONFIGS / "example-generic-cartesian.cfg").read_text()


@pytest.mark.parametrize("mode", ["COPY", "MIRROR"])
def test_the_second_carriage_follows_at_every_moment(tmp_path: Path, mode: str) -> None:
    """Motors a = x + y and u - y: in COPY u - x stays, in MIRROR u + x, while the head runs about."""
    rng = np.random.default_rng(3)
    points = np.round(rng.uniform((10, 5, 1), (60, 195, 20), (25, 3)), 3)
    start = 60 if mode == "COPY" else 10  # u, at 240 then, must have room
    gcode = f"G28\nG1 X{start} F9000\nSET_DUAL_CARRIAGE CARRIAGE=carriage_u MODE={mode}\nM400\n"
    run = batch(tmp_path, gcode + gcode_of(points) + "M400\n", IDEX)
    assert run.result == "exit", (run.message, run.replies)
    end = max(t.clocks[-1] for t in run.traces().values() if t.clocks) / CLOCK_HZ
    times = np.arange(end - 10.0, end, SAMPLE_S)
    motor = motor_places(run, times)
    y = motor["stepper y"]
    x, u = motor["stepper a"] - y, motor["stepper u"] + y
    kept = u - x if mode == "COPY" else u + x
    wanted = 240.0 - start if mode == "COPY" else 240.0 + start
    assert np.ptp(x) > 30.0
    # four motors, each within a step of 0.0125 mm (half a step of place, and the time of a step)
    assert np.abs(kept - wanted).max() < 0.05
    assert np.abs(y - motor["stepper y1"]).max() < 0.02


def test_changing_carriages_does_not_lose_place(tmp_path: Path) -> None:
    """Three hundred changes, anywhere between two steps: the motors end where they would without them."""
    rng = np.random.default_rng(5)
    changes = "".join(
        f"SET_DUAL_CARRIAGE CARRIAGE=carriage_u\nG1 X{u:.4f}\nSET_DUAL_CARRIAGE CARRIAGE=carriage_x\nG1 X{x:.4f}\n"
        for x, u in rng.uniform((50, 150), (60, 160), (150, 2))
    )
    back = "G1 X100.0021\nSET_DUAL_CARRIAGE CARRIAGE=carriage_u\nG1 X160.0037\n"
    ends = []
    for between in ("", changes):
        run = batch(tmp_path, f"G28\nG1 F9000\n{between}{back}", IDEX)
        assert run.result == "exit", (run.message, run.replies)
        traces = run.traces()
        ends.append((traces["stepper a"].position, traces["stepper u"].position))
    assert ends[0] == ends[1]


def test_an_axis_of_its_own_runs_in_step_with_the_head(tmp_path: Path) -> None:
    """The way of the extra axis is the same share of its move as the head's, at every moment."""
    config = (CONFIGS / "example-cartesian.cfg").read_text()
    config += "[manual_stepper turn]\nstep_pin: PE0\ndir_pin: PE1\nmicrosteps: 16\nrotation_distance: 40\n"
    moves = "G1 X20 U0 F6000\nM400\n" + "".join(f"G1 X{20 + 7 * i} U{3 * i}\n" for i in range(1, 20))
    gcode = f"G28\nMANUAL_STEPPER STEPPER=turn GCODE_AXIS=U INSTANTANEOUS_CORNER_VELOCITY=5\n{moves}M400\n"
    run = batch(tmp_path, gcode, config)
    assert run.result == "exit", (run.message, run.replies)
    traces = run.traces()
    u, x = traces["manual_stepper turn"], traces["stepper_x"]
    assert u.position == 57 * 80
    times = np.array(u.clocks)
    x_at = np.concatenate([[0], x.positions])[np.searchsorted(np.array(x.clocks), times, side="right")]
    x_mm = 153.0 + (x_at - x.position) * 0.0125
    u_mm = np.array(u.positions) * 0.0125
    assert np.abs((x_mm - 20.0) * 3 / 7 - u_mm).max() < 0.02


def test_the_extra_axis_keeps_its_limits(tmp_path: Path) -> None:
    config = (CONFIGS / "example-cartesian.cfg").read_text()
    config += "[manual_stepper turn]\nstep_pin: PE0\ndir_pin: PE1\nmicrosteps: 16\nrotation_distance: 40\n"
    gcode = (
        "G28\nMANUAL_STEPPER STEPPER=turn GCODE_AXIS=U LIMIT_VELOCITY=20 LIMIT_ACCEL=100\n"
        "G1 X100 U100 F12000\nM400\n"
    )
    run = batch(tmp_path, gcode, config)
    clocks = np.array(run.traces()["manual_stepper turn"].clocks) / CLOCK_HZ
    assert len(clocks) == 8000
    speeds = 80 * 0.0125 / (clocks[80:] - clocks[:-80])  # over 1 mm
    assert speeds.max() == pytest.approx(20.0, rel=2e-3)
    # 100 mm: 20^2/100 = 4 mm of ramps at half speed, the rest at full
    assert clocks[-1] - clocks[0] == pytest.approx(100.0 / 20.0 + 20.0 / 100.0, abs=0.03)
