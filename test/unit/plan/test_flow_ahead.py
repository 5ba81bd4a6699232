"""What the control law of an induction nozzle knows ahead: the part fan at the time of its change."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace
from typing import Any

from extras.induction.flow import LOOK_S, FlowAhead


class FakePrinter:
    def __init__(self, **objects: Any) -> None:
        self.objects = objects

    def lookup_object(self, name: str, default: Any = None) -> Any:
        return self.objects.get(name, default)


def looking_ahead(part_fan: Any) -> FlowAhead:
    printer: Any = FakePrinter(fan=part_fan)
    return FlowAhead(printer, "extruder")


def test_a_fan_that_is_to_change_after_queued_moves_has_its_speed_from_then_on() -> None:
    fan = SimpleNamespace(changes=deque([(10.0, 0.3)]))
    ahead = looking_ahead(SimpleNamespace(fan=fan))
    assert ahead.look(12.0)
    fan.changes.append((15.5, 1.0))
    assert ahead.look(12.0 + 2.0 * LOOK_S)
    assert [ahead.fan.at(time_s) for time_s in (9.0, 12.0, 15.4, 15.6)] == [0.0, 0.3, 0.3, 1.0]


def test_a_fan_that_does_not_say_when_is_left_out() -> None:
    ahead = looking_ahead(SimpleNamespace())
    assert ahead.look(1.0)
    assert ahead.fan.at(2.0) == 0.0
