"""Powers sent to the bridge, against those planned now."""

from __future__ import annotations

import math

import pytest

from bridge_rig import differs
from thermal.control.timeline import Bridge
from thermal.records import PhaseCommand, Planned

SENT = ((1.00, 5.0), (1.02, 9.0), (1.05, 7.0))


def line() -> Bridge:
    sent = Bridge()
    sent.note([PhaseCommand(time_s, 1000, power_w) for time_s, power_w in SENT], 0.99)
    return sent


def plan(*steps: tuple[float, float]) -> list[Planned]:
    return [Planned(*step) for step in steps]


def test_powers_sent_already_do_not_differ() -> None:
    assert not differs(line(), plan(*SENT), 0.5)
    assert not differs(line(), plan((1.00, 5.2), (1.02, 8.9), (1.05, 7.3)), 0.5)
    assert not differs(line(), plan((1.02, 9.0), (1.05, 7.0)), 0.5)  # from a later start


@pytest.mark.parametrize(
    "steps",
    [
        ((1.00, 5.6), (1.02, 9.0), (1.05, 7.0)),  # the first
        ((1.00, 5.0), (1.02, 9.0), (1.05, 7.0), (1.08, 8.0)),  # one more at the end
        ((1.00, 5.0), (1.02, 9.0)),  # one less
        ((1.00, 5.0), (1.05, 7.0)),  # one less between
        ((1.00, 5.0), (1.03, 9.0), (1.05, 7.0)),  # one later
        ((1.00, 5.0),),  # nothing of what was said holds any more
    ],
)
def test_any_step_that_differs_is_found(steps: tuple[tuple[float, float], ...]) -> None:
    assert differs(line(), plan(*steps), 0.5)


@pytest.mark.parametrize(
    ("from_s", "on"), [(0.99, True), (1.01, True), (1.02, True), (1.04, True), (1.05, False), (2.0, False)]
)
def test_a_line_of_commands_knows_whether_it_leaves_the_bridge_on(from_s: float, on: bool) -> None:
    sent = Bridge()
    sent.note([PhaseCommand(1.0, 0, 0.0), PhaseCommand(1.02, 2012, 1.5), PhaseCommand(1.05, 0, 0.0)], 0.99)
    assert sent.is_on_from(from_s) == on


@pytest.mark.parametrize(
    ("from_s", "until_s", "strongest_w"),
    [
        (1.00, 1.01, 5.0),
        (1.00, 1.02, 5.0),
        (1.01, 1.03, 9.0),
        (1.04, 1.06, 9.0),
        (1.05, 1.06, 7.0),
        (2.0, 2.1, 7.0),
    ],
)
def test_the_strongest_command_near_a_time_is_known(
    from_s: float, until_s: float, strongest_w: float
) -> None:
    assert line().strongest_w(from_s, until_s) == strongest_w


def test_commands_forgotten_are_not_known() -> None:
    sent = line()
    sent.note([PhaseCommand(3.0, 1000, 6.0)], 2.99)
    assert math.isnan(sent.strongest_w(1.0, 1.04))
    assert sent.strongest_w(1.06, 3.1) == 7.0
