"""kinematics: winch — the head hangs from cables, one a winch. Without endstops: G28 says "this is 0, 0, 0"."""

from __future__ import annotations

import string
from collections.abc import Sequence
from typing import Any

import stepper
from kinematics.delta_limits import lower_meeting_point
from lookahead import Coord, Move

FEWEST_WINCHES = 3


class WinchKinematics:
    """Positions of a cable machine."""

    def __init__(self, toolhead: Any, config: Any) -> None:
        self.steppers: list[stepper.MCU_stepper] = []
        self.anchors: list[tuple[float, float, float]] = []
        for name in string.ascii_lowercase:
            if len(self.anchors) >= FEWEST_WINCHES and not config.has_section(f"stepper_{name}"):
                break
            section = config.getsection(f"stepper_{name}")
            anchor = tuple(section.getfloat(f"anchor_{axis}") for axis in "xyz")
            winch = stepper.PrinterStepper(section)
            winch.setup_itersolve("winch_stepper_alloc", *anchor)
            winch.set_trapq(toolhead.get_trapq())
            self.steppers.append(winch)
            self.anchors.append((anchor[0], anchor[1], anchor[2]))
        xs, ys, zs = zip(*self.anchors, strict=True)
        self.axes_min = Coord(min(xs), min(ys), min(zs), 0.0)
        self.axes_max = Coord(max(xs), max(ys), max(zs), 0.0)
        self.set_position((0.0, 0.0, 0.0), ())

    def get_steppers(self) -> list[stepper.MCU_stepper]:
        return list(self.steppers)

    def calc_position(self, stepper_positions: dict[str, float]) -> list[float]:
        """x, y, z (mm) from the lengths of the first three cables: the head hangs below."""
        lengths = [stepper_positions[s.get_name()] for s in self.steppers[:3]]
        return lower_meeting_point(
            [(anchor, length**2) for anchor, length in zip(self.anchors[:3], lengths, strict=True)]
        )

    def set_position(self, newpos: Sequence[float], homing_axes: Sequence[int] | str = ()) -> None:
        for placed in self.steppers:
            placed.set_position(newpos)

    def clear_homing_state(self, clear_axes: Sequence[int] | str) -> None:
        """There is nothing to know or forget."""

    def home(self, homing_state: Any) -> None:
        homing_state.set_axes([0, 1, 2])
        homing_state.set_homed_position([0.0, 0.0, 0.0, None])

    def check_move(self, move: Move) -> None:
        """Cables reach everywhere between their anchors, and the user may go anywhere to find 0, 0, 0."""

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {"homed_axes": "xyz", "axis_minimum": self.axes_min, "axis_maximum": self.axes_max}


def load_kinematics(toolhead: Any, config: Any) -> WinchKinematics:
    return WinchKinematics(toolhead, config)
