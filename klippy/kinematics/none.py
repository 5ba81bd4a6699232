"""kinematics: none — a machine without axes (only heaters, fans, manual steppers)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lookahead import Coord, Move


class NoneKinematics:
    """Accepts no move."""

    def __init__(self, toolhead: Any, config: Any) -> None:
        self.axes_minmax = Coord(0.0, 0.0, 0.0, 0.0)

    def get_steppers(self) -> list[Any]:
        return []

    def calc_position(self, stepper_positions: dict[str, float]) -> list[float]:
        return [0.0, 0.0, 0.0]

    def set_position(self, newpos: Sequence[float], homing_axes: Sequence[int] | str = ()) -> None:
        """There is nothing to place."""

    def clear_homing_state(self, clear_axes: Sequence[int] | str) -> None:
        """Nothing is ever homed."""

    def home(self, homing_state: Any) -> None:
        """Nothing to home."""

    def check_move(self, move: Move) -> None:
        """No axes: every move is accepted and turns no motor."""

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {"homed_axes": "", "axis_minimum": self.axes_minmax, "axis_maximum": self.axes_minmax}


def load_kinematics(toolhead: Any, config: Any) -> NoneKinematics:
    return NoneKinematics(toolhead, config)
