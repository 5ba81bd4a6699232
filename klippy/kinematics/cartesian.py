"""kinematics: cartesian — each axis is driven by its own rail: a = x, b = y, c = z."""

from __future__ import annotations

from typing import Any

from kinematics.axes import LinearKinematics, LinearMachine

MACHINE = LinearMachine(
    (("cartesian_stepper_alloc", b"x"), ("cartesian_stepper_alloc", b"y"), ("cartesian_stepper_alloc", b"z")),
    lambda a, b, c: [a, b, c],
)


def load_kinematics(toolhead: Any, config: Any) -> LinearKinematics:
    return LinearKinematics(toolhead, config, MACHINE)


CartKinematics = LinearKinematics  # the name plugins know
