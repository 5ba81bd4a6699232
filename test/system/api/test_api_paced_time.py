"""The clock that holds the simulated world back to the wall clock, without a world."""

from __future__ import annotations

from typing import Any

import pytest

from paced_host import SLIP_S, STEP_S, PacedTime


class FakeWorld:
    """Stands for SimTime: moves to the requested time at once."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now

    def wait(self, until: float, poll: Any) -> None:
        self.now = max(self.now, until)


class FakePoll:
    """Stands for FdPoll: waiting lets the wall clock go on; `ready` is reported once."""

    def __init__(self, wall: list[float]) -> None:
        self.wall = wall
        self.ready = False

    def poll(self, timeout_s: float) -> bool:
        self.wall[0] += max(timeout_s, 0.0) + 1e-6  # a real clock never stands still
        ready, self.ready = self.ready, False
        return ready


@pytest.mark.parametrize("speed", [0.5, 1.0, 10.0])
def test_the_world_keeps_the_speed_of_the_wall_clock(speed: float) -> None:
    wall = [5.0]
    world, poll = FakeWorld(), FakePoll(wall)
    time = PacedTime(world, speed, lambda: wall[0])  # type: ignore[arg-type]
    while wall[0] < 7.0:
        time.wait(1e9, poll)  # type: ignore[arg-type]
        ahead_s = (world.now - 100.0) - (wall[0] - 5.0) * speed
        # never ahead, and behind by no more than a step
        assert -(STEP_S + 1e-5) * speed <= ahead_s <= 1e-9
    assert time.lost_s == 0.0


def test_a_descriptor_ends_the_wait_before_the_world_moves() -> None:
    wall = [5.0]
    world, poll = FakeWorld(), FakePoll(wall)
    time = PacedTime(world, 1.0, lambda: wall[0])  # type: ignore[arg-type]
    poll.ready = True
    time.wait(1e9, poll)  # type: ignore[arg-type]
    assert world.now == 100.0


def test_time_lost_is_given_up_and_counted() -> None:
    wall = [5.0]
    world, poll = FakeWorld(), FakePoll(wall)
    time = PacedTime(world, 1.0, lambda: wall[0])  # type: ignore[arg-type]
    wall[0] += 3.0  # the computer slept
    time.wait(1e9, poll)  # type: ignore[arg-type]
    assert time.lost_s == pytest.approx(3.0)
    assert world.now < 100.0 + SLIP_S


def test_waiting_without_sleeping_does_not_stop_time() -> None:
    wall = [5.0]
    world, poll = FakeWorld(), FakePoll(wall)
    time = PacedTime(world, 1.0, lambda: wall[0])  # type: ignore[arg-type]
    for _ in range(100):
        wall[0] += 0.05  # the host is busy for 50 ms between its looks at the clock
        before = world.now
        time.wait(world.now, poll)  # type: ignore[arg-type]
        # time goes on, by no more than a step: a slow computer is no reason to be late
        assert world.now == pytest.approx(before + STEP_S)
