"""kinematics: cartesian — each axis is driven by its own rail: a = x, b = y, c = z."""

from __future__ import annotations

from typing import Any

from kinematics import idex
from kinematics.axes import BoxKinematics, LinearKinematics, LinearMachine

MACHINE = LinearMachine(
    (("cartesian_stepper_alloc", b"x"), ("cartesian_stepper_alloc", b"y"), ("cartesian_stepper_alloc", b"z")),
    lambda a, b, c: [a, b, c],
)


def load_kinematics(toolhead: Any, config: Any) -> BoxKinematics:
    if config.has_section(idex.SECTION):
        return idex.load_dual(toolhead, config, MACHINE, "xy")
    return LinearKinematics(toolhead, config, MACHINE)


CartKinematics = LinearKinematics  # the name plugins know
