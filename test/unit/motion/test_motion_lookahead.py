"""Look-ahead: speeds join, limits hold, the plan does not depend on when it is made."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, seed, settings
from hypothesis import strategies as st

from lookahead import LookAheadQueue, Move

EPS = 1e-6  # mm/s: rounding of square roots


class FreeExtruder:
    """No limit of its own."""

    def calc_junction(self, prev: Move, move: Move) -> float:
        return move.max_cruise_v2


def machine(accel: float = 3000.0, corner: float = 5.0, ratio: float = 0.5, speed: float = 300.0) -> Any:
    return SimpleNamespace(
        max_accel=accel,
        max_velocity=speed,
        junction_deviation=corner**2 * (math.sqrt(2.0) - 1.0) / accel,
        max_accel_to_decel=accel * (1.0 - ratio),
        printer=SimpleNamespace(command_error=ValueError),
    )


def queue_points(toolhead: Any, points: list[tuple[float, ...]], speeds: list[float]) -> LookAheadQueue:
    queue = LookAheadQueue()
    for start, end, speed in zip(points[:-1], points[1:], speeds, strict=True):
        move = Move(toolhead, start, end, speed)
        if move.move_d:
            queue.add_move(move, FreeExtruder())
    return queue


def random_points(rng: np.random.Generator, count: int) -> tuple[list[tuple[float, ...]], list[float]]:
    """Short and long moves, arcs, zigzags, some of the extruder alone."""
    points, heading = [(0.0, 0.0, 0.0, 0.0)], 0.0
    for _ in range(count):
        x, y, z, e = points[-1]
        kind = rng.random()
        if kind < 0.08:
            points.append((x, y, z, e + rng.uniform(-2.0, 2.0)))
            continue
        heading += rng.normal(0.0, 0.1) if kind < 0.6 else rng.uniform(-math.pi, math.pi)
        d = 10.0 ** rng.uniform(-1.5, 1.7)
        points.append((x + d * math.cos(heading), y + d * math.sin(heading), z, e + 0.03 * d))
    return points, list(10.0 ** rng.uniform(0.3, 2.6, count))


def check_plan(toolhead: Any, moves: list[Move]) -> None:
    speed = 0.0
    for prev, move in zip([None, *moves], moves, strict=False):
        assert move.start_v == pytest.approx(speed, abs=EPS), "speeds must agree at the joint"
        assert move.cruise_v <= math.sqrt(move.max_cruise_v2) + EPS
        assert move.cruise_v >= max(move.start_v, move.end_v) - EPS
        assert min(move.accel_t, move.cruise_t, move.decel_t) >= 0.0
        way = 0.5 * (move.start_v + move.cruise_v) * move.accel_t + move.cruise_v * move.cruise_t
        way += 0.5 * (move.end_v + move.cruise_v) * move.decel_t
        assert way == pytest.approx(move.move_d, abs=1e-7)
        for change, time in (
            (move.cruise_v - move.start_v, move.accel_t),
            (move.cruise_v - move.end_v, move.decel_t),
        ):
            assert change == pytest.approx(move.accel * time, abs=EPS)
        if prev is not None and prev.is_kinematic_move and move.is_kinematic_move:
            check_corner(toolhead, prev, move)
        elif prev is not None:
            assert move.start_v == 0.0, "the head rests beside a move of the extruder alone"
        speed = move.end_v
    assert speed == 0.0


def check_corner(toolhead: Any, prev: Move, move: Move) -> None:
    """The speed through the corner, against circles fitted into it by vectors."""
    a, b = np.array(prev.axes_r[:3]), np.array(move.axes_r[:3])
    angle = math.pi - math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))  # between the lines
    if angle > math.pi - 1e-3:
        return
    deviation = toolhead.junction_deviation
    outer = deviation / (1.0 / math.sin(angle / 2.0) - 1.0) if angle > 1e-9 else 0.0
    inner = 0.5 * min(prev.move_d, move.move_d) * math.tan(angle / 2.0)
    allowed = math.sqrt(toolhead.max_accel * min(outer, inner))
    assert move.start_v <= allowed * (1.0 + 1e-4) + 1e-3


@seed(20261121)
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.5, 0.9]), st.sampled_from([0.0, 5.0, 20.0]))
def test_random_paths_keep_every_limit(number: int, ratio: float, corner: float) -> None:
    toolhead = machine(corner=corner, ratio=ratio)
    queue = queue_points(toolhead, *random_points(np.random.default_rng(number), 60))
    check_plan(toolhead, queue.flush())


@seed(20261122)
@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.sampled_from([0.0, 0.5, 0.9]))
def test_planning_early_gives_the_same_speeds(number: int, often: int, ratio: float) -> None:
    points, speeds = random_points(np.random.default_rng(number), 80)
    toolhead = machine(ratio=ratio)
    whole = queue_points(toolhead, points, speeds).flush()
    queue, pieces = LookAheadQueue(), []
    for index, (start, end, speed) in enumerate(zip(points[:-1], points[1:], speeds, strict=True)):
        queue.add_move(Move(toolhead, start, end, speed), FreeExtruder())
        if index % often == 0:
            pieces += queue.flush(lazy=True)
    pieces += queue.flush()
    for one, other in zip(whole, pieces, strict=True):
        for name in ("start_v", "cruise_v", "end_v"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), abs=EPS)
    check_plan(toolhead, pieces)


def total_time(moves: list[Move]) -> float:
    return sum(m.accel_t + m.cruise_t + m.decel_t for m in moves)


def test_a_line_in_pieces_takes_as_long_as_the_line() -> None:
    whole = queue_points(machine(), [(0.0,) * 4, (40.0, 0.0, 0.0, 0.0)], [200.0]).flush()
    pieces = queue_points(machine(), [(0.4 * i, 0.0, 0.0, 0.0) for i in range(101)], [200.0] * 100).flush()
    assert total_time(pieces) == pytest.approx(total_time(whole), rel=1e-9)


def test_right_angle_is_taken_at_the_square_corner_velocity() -> None:
    moves = queue_points(
        machine(), [(0.0,) * 4, (50.0, 0.0, 0.0, 0.0), (50.0, 50.0, 0.0, 0.0)], [200.0] * 2
    ).flush()
    assert moves[1].start_v == pytest.approx(5.0, rel=1e-9)


def test_turning_back_stops() -> None:
    moves = queue_points(
        machine(), [(0.0,) * 4, (50.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)], [200.0] * 2
    ).flush()
    assert moves[0].end_v == moves[1].start_v == 0.0


def test_a_minimum_cruise_ratio_leaves_that_share_for_cruising() -> None:
    """One short move from rest to rest. With the virtual acceleration a*(1-r) the top is v^2 = a*(1-r)*d, so the
    ramps at full acceleration take (1-r)*d and r*d is left."""
    for ratio in (0.0, 0.5, 0.8):
        (move,) = queue_points(machine(ratio=ratio), [(0.0,) * 4, (2.0, 0.0, 0.0, 0.0)], [300.0]).flush()
        assert move.cruise_v * move.cruise_t == pytest.approx(ratio * 2.0, abs=1e-6)


def test_zigzag_is_slower_with_a_minimum_cruise_ratio() -> None:
    points = [(1.0 * i, 2.0 * (i % 2), 0.0, 0.0) for i in range(30)]
    fast = queue_points(machine(ratio=0.0), points, [300.0] * 29).flush()
    slow = queue_points(machine(ratio=0.5), points, [300.0] * 29).flush()
    assert max(m.cruise_v for m in slow) < 0.8 * max(m.cruise_v for m in fast)


def test_limit_speed_only_lowers() -> None:
    move = Move(machine(), (0.0,) * 4, (10.0, 0.0, 5.0, 0.0), 100.0)
    move.limit_speed(500.0, 90000.0)
    assert (move.max_cruise_v2, move.accel) == (10000.0, 3000.0)
    move.limit_speed(20.0, 100.0)
    assert (move.max_cruise_v2, move.accel) == (400.0, 100.0)
    assert move.min_move_t == pytest.approx(math.sqrt(125.0) / 20.0)
    assert move.smooth_delta_v2 <= move.delta_v2


def test_unlimited_acceleration_is_never_used_for_the_head() -> None:
    move = Move(machine(), (0.0,) * 4, (0.0, 0.0, 0.0, 2.0), 50.0)
    assert not move.is_kinematic_move
    assert move.accel > 1e7  # until the extruder has had its say
    assert move.axes_r[3] == 1.0
