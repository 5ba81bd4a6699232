"""Every kinematics: step times against the machine's own geometry, and the example configs load, home and move."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motion_rig import FFI, LIB, MAX_ERROR_S, CStepper, batch

CONFIGS = Path(__file__).resolve().parents[3] / "config"
TICK_S = 1.0 / 72e6
# Fitted pieces are good to a hundredth of a microsecond at print speeds; this slack, a ten-thousandth of a step, only
# matters where a stepper turns around and stands almost still.
SLACK_STEPS = 1e-4

Path3 = Callable[[np.ndarray], np.ndarray]


class Polyline:
    """Straight moves between random points, each from rest to rest, and their own arithmetic."""

    def __init__(self, points: np.ndarray, speeds: np.ndarray, accel: float, start: float = 1.0) -> None:
        self.points, self.accel = points, accel
        ways = np.linalg.norm(np.diff(points, axis=0), axis=1)
        self.tops = np.minimum(speeds, np.sqrt(ways * accel))
        self.ramps = self.tops / accel
        self.cruises = ways / self.tops - self.ramps
        lengths = 2 * self.ramps + self.cruises
        self.starts = start + np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
        self.end_time = start + lengths.sum()
        self.ways = ways

    def append(self, trapq: Any) -> None:
        for i, way in enumerate(self.ways):
            ratio = (self.points[i + 1] - self.points[i]) / way
            LIB.trapq_append(
                trapq, self.starts[i], self.ramps[i], self.cruises[i], self.ramps[i],
                *self.points[i], *ratio, 0.0, self.tops[i], self.accel,
            )  # fmt: skip

    def at(self, t: np.ndarray) -> np.ndarray:
        i = np.clip(np.searchsorted(self.starts, t, side="right") - 1, 0, len(self.ways) - 1)
        ramp, cruise, top = self.ramps[i], self.cruises[i], self.tops[i]
        tau = np.clip(t - self.starts[i], 0.0, 2 * ramp + cruise)
        up = np.minimum(tau, ramp)
        down = np.maximum(tau - ramp - cruise, 0.0)
        d = self.accel * up**2 / 2 + top * (tau - up) - self.accel * down**2 / 2
        share = np.clip(d / self.ways[i], 0.0, 1.0)
        return self.points[i] + share[:, None] * (self.points[i + 1] - self.points[i])


def unwrapped_angle(xyz: np.ndarray, near: np.ndarray) -> np.ndarray:
    angle = np.arctan2(xyz[:, 1], xyz[:, 0])
    return angle - 2 * np.pi * np.round((angle - near) / (2 * np.pi))


def rotary(xyz: np.ndarray) -> np.ndarray:
    """The angle at which the elbow is a lower arm's length from the head, by bisection."""
    radius, height, direction, upper, lower = 33.9, 412.9, math.radians(150), 170.0, 320.0
    out = xyz[:, 0] * math.cos(direction) + xyz[:, 1] * math.sin(direction) - radius
    side = -xyz[:, 0] * math.sin(direction) + xyz[:, 1] * math.cos(direction)
    up = xyz[:, 2] - height
    # turning the arm up from where it points at the head takes the elbow away from it
    low = np.arctan2(up, out)
    high = low + math.pi
    for _ in range(60):
        middle = 0.5 * (low + high)
        away = (
            np.sqrt((out - upper * np.cos(middle)) ** 2 + side**2 + (up - upper * np.sin(middle)) ** 2)
            > lower
        )
        high, low = np.where(away, middle, high), np.where(away, low, middle)
    return 0.5 * (low + high)


TOWER = (-151.3, -87.4)
MACHINES: dict[str, tuple[Callable[[], Any], Callable[[np.ndarray], np.ndarray], float]] = {
    "corexy+": (lambda: LIB.corexy_stepper_alloc(b"+"), lambda p: p[:, 0] + p[:, 1], 0.0125),
    "corexy-": (lambda: LIB.corexy_stepper_alloc(b"-"), lambda p: p[:, 0] - p[:, 1], 0.0125),
    "corexz+": (lambda: LIB.corexz_stepper_alloc(b"+"), lambda p: p[:, 0] + p[:, 2], 0.0125),
    "corexz-": (lambda: LIB.corexz_stepper_alloc(b"-"), lambda p: p[:, 0] - p[:, 2], 0.0125),
    "generic": (
        lambda: LIB.generic_cartesian_stepper_alloc(0.5, -1.0, 2.0),
        lambda p: 0.5 * p[:, 0] - p[:, 1] + 2.0 * p[:, 2],
        0.0125,
    ),
    "delta": (
        lambda: LIB.delta_stepper_alloc(333.0**2, *TOWER),
        lambda p: p[:, 2] + np.sqrt(333.0**2 - (p[:, 0] - TOWER[0]) ** 2 - (p[:, 1] - TOWER[1]) ** 2),
        0.0125,
    ),
    "deltesian": (
        lambda: LIB.deltesian_stepper_alloc(210.0**2, -110.0),
        lambda p: p[:, 2] + np.sqrt(210.0**2 - (p[:, 0] + 110.0) ** 2),
        0.0125,
    ),
    "winch": (
        lambda: LIB.winch_stepper_alloc(-300.0, 200.0, 150.0),
        lambda p: np.linalg.norm(p - np.array([-300.0, 200.0, 150.0]), axis=1),
        0.0125,
    ),
    "polar r": (lambda: LIB.polar_stepper_alloc(b"r"), lambda p: np.hypot(p[:, 0], p[:, 1]), 0.0125),
    "rotary delta": (
        lambda: LIB.rotary_delta_stepper_alloc(33.9, 412.9, math.radians(150), 170.0, 320.0),
        rotary,
        2 * math.pi / (3200 * 107 / 16 * 60 / 16),
    ),
}


def random_path(seed: int, count: int = 60) -> Polyline:
    rng = np.random.default_rng(seed)
    # within 85 mm of the centre of the bed; never within a few mm of it (polar machines slow down there)
    points = np.column_stack(
        [rng.uniform(-60, 60, count), rng.uniform(-60, 60, count), rng.uniform(0.0, 60.0, count)]
    )
    return Polyline(points, rng.uniform(5.0, 250.0, count - 1), 3000.0)


def run_stepper(solver: Any, line: Polyline, step_dist: float) -> CStepper:
    stepper = CStepper(step_dist, solver=solver)
    follow(stepper, line)
    return stepper


def follow(stepper: CStepper, line: Polyline) -> None:
    """From its first point to its end, in pieces of time as the host generates steps."""
    stepper.open()
    LIB.trapq_set_position(stepper.trapq, 0.5, *line.points[0])
    LIB.itersolve_set_position(stepper.sk, *line.points[0])
    line.append(stepper.trapq)
    for until in np.arange(0.3, line.end_time + 0.5, 0.23):
        stepper.run(float(until), float(until) - 0.05)
    stepper.run(line.end_time + 1.0)


def check_steps(
    stepper: CStepper, where: Callable[[np.ndarray], np.ndarray], origin: float, end: float
) -> None:
    """No step late, none more than 25 us early, and the last one at the end of the way."""
    d = stepper.step_dist
    assert stepper.trace.intervals_ok
    t = stepper.step_times()
    assert len(t) > 100 and np.all(np.diff(t) > 0)
    after = np.array(stepper.trace.positions)
    before = np.concatenate([[0], after[:-1]])
    edges = origin + 0.5 * (before + after) * d
    forward = np.sign(after - before)
    slack = SLACK_STEPS * d
    late = forward * (where(t - TICK_S) - edges)
    early = forward * (where(t + MAX_ERROR_S + TICK_S) - edges)
    assert late.max() <= slack, "a step after its time"
    assert early.min() >= -slack, "a step more than 25 us before its time"
    assert abs(origin + stepper.trace.position * d - end) <= 0.5 * d + slack


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_steps_follow_the_geometry(name: str, seed: int) -> None:
    alloc, position, step_dist = MACHINES[name]
    line = random_path(seed)
    stepper = run_stepper(alloc(), line, step_dist)
    ends = position(line.points[[0, -1]])
    check_steps(stepper, lambda t: position(line.at(t)), ends[0], ends[1])


def test_the_polar_bed_turns_on_across_half_a_turn() -> None:
    """Around the centre twice: the angle goes on to 4 pi, it does not jump back."""
    turns = np.linspace(0.0, 4 * np.pi, 61)
    points = np.column_stack([50 * np.cos(turns), 50 * np.sin(turns), 0 * turns])
    line = Polyline(points, np.full(60, 80.0), 3000.0)
    step = 2 * math.pi / (3200 * 5)
    stepper = run_stepper(LIB.polar_stepper_alloc(b"a"), line, step)
    fine = np.linspace(1.0, line.end_time, 200001)
    angles = np.unwrap(np.arctan2(*line.at(fine).T[1::-1]))

    def where(t: np.ndarray) -> np.ndarray:
        return unwrapped_angle(line.at(t), np.interp(t, fine, angles))

    check_steps(stepper, where, 0.0, 4 * math.pi)


def test_solvers_refuse_what_they_do_not_know() -> None:
    for alloc in (LIB.corexy_stepper_alloc, LIB.corexz_stepper_alloc, LIB.polar_stepper_alloc):
        assert alloc(b"q") == FFI.NULL


# ---- whole machines, from their example configs ----

HOME_AND_MOVE = "G28\n{}M400\nGET_POSITION\n"
SQUARE = "G1 X{x} Y{y} Z{z} F6000\nG1 X{x1}\nG1 Y{y1}\nG1 X{x} Z{z1}\nG1 Y{y}\n"
FLAT = {"x": 20, "y": 30, "z": 5, "x1": 60, "y1": 70, "z1": 9}
ROUND = {"x": -40, "y": -30, "z": 10, "x1": 45, "y1": 35, "z1": 20}
EXAMPLES = {
    "cartesian": FLAT, "corexy": FLAT, "corexz": FLAT, "hybrid-corexy": FLAT, "hybrid-corexz": FLAT,
    "delta": ROUND, "deltesian": {**ROUND, "y": 30, "y1": 70}, "rotary-delta": ROUND, "polar": FLAT, "winch": ROUND,
}  # fmt: skip


def positions(replies: list[str]) -> dict[str, dict[str, float]]:
    """The rows of GET_POSITION."""
    text = next(r for r in replies if "kinematic:" in r)
    rows = {}
    for line in text.removeprefix("// ").split("\n"):
        name, _, values = line.removeprefix("// ").partition(": ")
        rows[name] = {k: float(v) for k, v in (pair.split(":") for pair in values.split())}
    return rows


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_config_homes_and_moves(tmp_path: Path, name: str) -> None:
    """The motors end where the head is said to be: the inverse of the kinematics agrees to a step."""
    gcode = HOME_AND_MOVE.format(SQUARE.format(**EXAMPLES[name]))
    outcome = batch(tmp_path, gcode, (CONFIGS / f"example-{name}.cfg").read_text())
    assert outcome.result == "exit", (outcome.message, outcome.replies)
    rows = positions(outcome.replies)
    wanted = {"X": EXAMPLES[name]["x"], "Y": EXAMPLES[name]["y"], "Z": EXAMPLES[name]["z1"]}
    for axis, value in wanted.items():
        assert rows["toolhead"][axis] == pytest.approx(value)
        # a step is 0.0125 mm on a motor; slanted arms stretch that by their lever, up to a few times
        assert rows["kinematic"][axis] == pytest.approx(value, abs=0.05)


OUTSIDE = [
    ("corexy", "G1 X300", "Move out of range"),
    ("delta", "G1 X150 Y150 Z10", "Move out of range"),
    ("delta", "G1 Z400", "Move out of range"),
    ("deltesian", "G1 X120 Z10", "Move out of range"),
    ("rotary-delta", "G1 X400 Z10", "Move out of range"),
    ("rotary-delta", "G1 Y-225 Z10", "Move out of range"),  # two lower arms lean sideways, and end too short
    ("polar", "G1 X250 Y250", "Move out of range"),
    ("polar", "G1 X50 Y0\nG1 X-50", "through the centre"),
]


@pytest.mark.parametrize(("name", "line", "text"), OUTSIDE)
def test_moves_outside_are_refused(tmp_path: Path, name: str, line: str, text: str) -> None:
    outcome = batch(tmp_path, f"G28\n{line} F6000\n", (CONFIGS / f"example-{name}.cfg").read_text())
    assert outcome.result == "error_exit"
    assert any(text in r for r in outcome.replies if r.startswith("!!"))


def test_a_rotary_delta_reaches_the_whole_of_its_rim(tmp_path: Path) -> None:
    """The limits hold in every direction, low and high: the motors end where the head is said to be."""
    config = (CONFIGS / "example-rotary-delta.cfg").read_text()
    for z in (0, 240):
        rim = [(203.5 * math.cos(a), 203.5 * math.sin(a)) for a in map(math.radians, range(0, 361, 10))]
        gcode = f"G1 Z{z} F3000\n" + "".join(f"G1 X{x:.3f} Y{y:.3f}\n" for x, y in rim)
        outcome = batch(tmp_path, HOME_AND_MOVE.format(gcode), config)
        assert outcome.result == "exit", (outcome.message, outcome.replies)
        assert positions(outcome.replies)["kinematic"]["X"] == pytest.approx(203.5, abs=0.05)


@pytest.mark.parametrize("name", ["corexy", "delta", "deltesian", "rotary-delta", "polar"])
def test_moves_before_homing_are_refused(tmp_path: Path, name: str) -> None:
    outcome = batch(tmp_path, "G1 X10 F6000\n", (CONFIGS / f"example-{name}.cfg").read_text())
    assert any("Must home" in r for r in outcome.replies if r.startswith("!!"))
