"""Limits: of the plan, move by move; and of what the steps make of it where motors mix the axes linearly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from batch_messages import MAX_ERROR_S
from motion_exact import LINEAR, head_epochs
from motion_oracle import Run

NEAR = 1.0 + 1e-9
# of planned speeds: sums of distances of a thousand moves
ROUNDING = 1e-6
# Speeds and accelerations of the steps are looked at over this time: rounding to steps is small against it.
WINDOW_S = 0.030


@dataclass(frozen=True)
class Wanted:
    """What was in force when a move came in."""

    end_pos: tuple[float, ...]
    max_velocity: float
    max_accel: float
    corner_velocity: float
    allowed_speed: float


def planned(run: Run) -> list[tuple[Any, Wanted]]:
    moves = [what for kind, what in run.recording.log if kind == "move"]
    wanted = [Wanted(*row) for row in run.recording.wanted]
    assert [m.end_pos for m in moves] == [w.end_pos for w in wanted], "moves lost or out of order"
    return list(zip(moves, wanted, strict=True))


def plan_faults(run: Run) -> list[str]:
    """Everything in the plan that no limit allows."""
    faults: list[str] = []
    options, before = run.options["printer"], None
    z_speed = options.getfloat("max_z_velocity", math.inf)
    z_accel = options.getfloat("max_z_accel", math.inf)
    for move, wanted in planned(run):
        at = f"move at {move.print_time:.4f} s to {move.end_pos}: "
        kinematic = move.is_kinematic_move
        tests = {
            "speeds": min(move.start_v, move.end_v) >= 0.0
            and max(move.start_v, move.end_v) <= move.cruise_v * NEAR,
            "times": min(move.accel_t, move.cruise_t, move.decel_t) >= 0.0,
            "way": abs(_way(move) - move.move_d) <= ROUNDING,
            "speed wanted": move.cruise_v <= wanted.allowed_speed * NEAR,
            "max_velocity": not kinematic or move.cruise_v <= wanted.max_velocity * NEAR,
            "max_accel": not kinematic or move.accel <= wanted.max_accel * NEAR,
            "max_z_velocity": abs(move.axes_r[2]) * move.cruise_v <= z_speed * NEAR,
            "max_z_accel": abs(move.axes_r[2]) * move.accel <= z_accel * NEAR,
            "extruder alone": _extruder_alone_ok(run, move),
        }
        faults += [at + name for name, holds in tests.items() if not holds]
        faults += [at + text for text in _joint_faults(before, move, wanted)]
        before = (move, wanted)
    if before is not None and before[0].end_v > ROUNDING:
        faults.append("the last move does not end at rest")
    return faults


def _way(move: Any) -> float:
    up = 0.5 * (move.start_v + move.cruise_v) * move.accel_t
    down = 0.5 * (move.end_v + move.cruise_v) * move.decel_t
    ramps = (move.cruise_v - move.start_v, move.accel * move.accel_t)
    assert math.isclose(*ramps, rel_tol=1e-6, abs_tol=1e-6), "ramp of another acceleration"
    return up + move.cruise_v * move.cruise_t + down


def _extruder_alone_ok(run: Run, move: Any) -> bool:
    """Retractions, and moves of filament without x and y: what the head's limits mean at the widest extrusion."""
    e = move.axes_r[3]
    if not e or (e > 0.0 and (move.axes_d[0] or move.axes_d[1])):
        return True
    share = 4.0 * 0.4**2 / (math.pi * 0.25 * 1.75**2)
    options = run.options["printer"]
    speed = (options.getfloat("max_velocity") or 0.0) * share
    accel = (options.getfloat("max_accel") or 0.0) * share
    return abs(e) * move.cruise_v <= speed * NEAR and abs(e) * move.accel <= accel * NEAR


def _joint_faults(before: tuple[Any, Wanted] | None, move: Any, wanted: Wanted) -> list[str]:
    if before is None:
        return [] if move.start_v <= ROUNDING else ["starts at speed"]
    last, last_wanted = before
    end = last.print_time + last.accel_t + last.cruise_t + last.decel_t
    faults = []
    if move.print_time < end - 1e-9:
        faults.append("begins before the one before ends")
    if move.print_time > end + 1e-9:
        return [*faults, *(["speed across a rest"] if max(last.end_v, move.start_v) > ROUNDING else [])]
    if abs(last.end_v - move.start_v) > ROUNDING:
        faults.append(f"speed jumps from {last.end_v} to {move.start_v}")
    if move.start_v > ROUNDING:
        faults += _corner_faults(last, move, min(last_wanted.corner_velocity, wanted.corner_velocity))
    return faults


def _corner_faults(last: Any, move: Any, corner_velocity: float) -> list[str]:
    """At a right angle not faster than square_corner_velocity, elsewhere as its circle through the corner allows."""
    if not (last.is_kinematic_move and move.is_kinematic_move):
        return ["passes a move of the extruder alone at speed"]
    cosine = float(np.dot(last.axes_r[:3], move.axes_r[:3]))
    half = math.sqrt(max(0.0, 0.5 * (1.0 + cosine)))  # sine of half the angle between the two lines
    faults = []
    if half < 1.0 - 1e-8:
        allowed = corner_velocity**2 * (math.sqrt(2.0) - 1.0) * half / (1.0 - half)
        if move.start_v**2 > allowed * (1.0 + 1e-6) + ROUNDING:
            faults.append(f"corner at {move.start_v:.3f}, allowed {math.sqrt(allowed):.3f}")
    if abs(move.axes_r[3] - last.axes_r[3]) * move.start_v > 1.0 + ROUNDING:
        faults.append("speed of the filament jumps by more than 1 mm/s")
    return faults


def step_faults(run: Run, seed: int = 0) -> tuple[int, list[str]]:
    """How many windows of time were looked at, and in which the steps made the head too fast or too hasty."""
    kind = run.options["printer"]["kinematics"]
    names = list(LINEAR[kind])
    motors = [run.motors[f"stepper_{n}"] for n in names]
    steps = [run.steps[f"stepper_{n}"] for n in names]
    to_axes = np.linalg.inv(np.array([LINEAR[kind][n] for n in names], dtype=float))
    dists = np.array([m.get_step_dist() for m in motors])
    one_step = np.abs(to_axes) @ dists

    def head(t: np.ndarray) -> np.ndarray:
        counted = np.column_stack([s.count_at(t) for s in steps]) * dists
        return counted @ to_axes.T

    rng, faults, windows = np.random.default_rng(seed), [], 0
    reach = max(e.reach_s for e in head_epochs(run.recording.log))
    for move, wanted in planned(run):
        total = move.accel_t + move.cruise_t + move.decel_t
        room = total - 2.0 * (WINDOW_S + reach)
        if room <= 0.0 or not move.is_kinematic_move:
            continue
        t = move.print_time + reach + WINDOW_S + rng.uniform(0.0, room, 3)
        a, b, c = head(t - WINDOW_S), head(t), head(t + WINDOW_S)
        windows += len(t)
        error = np.linalg.norm(one_step) + 2 * MAX_ERROR_S * wanted.max_velocity
        if np.linalg.norm(c - a, axis=1).max() > wanted.max_velocity * 2 * WINDOW_S + error:
            faults.append(f"too fast at {t[0]:.3f} s")
        if np.linalg.norm(a - 2 * b + c, axis=1).max() > wanted.max_accel * WINDOW_S**2 + 2 * error:
            faults.append(f"too hasty at {t[0]:.3f} s")
    return windows, faults
