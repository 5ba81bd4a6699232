"""kinematics: corexy — x and y are driven by two motors together: a = x + y, b = x - y."""

from __future__ import annotations

from typing import Any

from kinematics.axes import LinearKinematics, LinearMachine

MACHINE = LinearMachine(
    (("corexy_stepper_alloc", b"+"), ("corexy_stepper_alloc", b"-"), ("cartesian_stepper_alloc", b"z")),
    lambda a, b, c: [0.5 * (a + b), 0.5 * (a - b), c],
)


def load_kinematics(toolhead: Any, config: Any) -> LinearKinematics:
    return LinearKinematics(toolhead, config, MACHINE)
