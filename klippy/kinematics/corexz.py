"""kinematics: corexz — x and z are driven by two motors together: a = x + z, c = x - z."""

from __future__ import annotations

from typing import Any

from kinematics.axes import LinearKinematics, LinearMachine

MACHINE = LinearMachine(
    (("corexz_stepper_alloc", b"+"), ("cartesian_stepper_alloc", b"y"), ("corexz_stepper_alloc", b"-")),
    lambda a, b, c: [0.5 * (a + c), b, 0.5 * (a - c)],
)


def load_kinematics(toolhead: Any, config: Any) -> LinearKinematics:
    return LinearKinematics(toolhead, config, MACHINE)
