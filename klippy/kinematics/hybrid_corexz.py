"""kinematics: hybrid_corexz — z has a motor of its own, x is driven against it: a = x - z, c = z."""

from __future__ import annotations

from typing import Any

from kinematics import idex
from kinematics.axes import BoxKinematics, LinearKinematics, LinearMachine

MACHINE = LinearMachine(
    (("corexz_stepper_alloc", b"-"), ("cartesian_stepper_alloc", b"y"), ("cartesian_stepper_alloc", b"z")),
    lambda a, b, c: [a + c, b, c],
)


def load_kinematics(toolhead: Any, config: Any) -> BoxKinematics:
    if config.has_section(idex.SECTION):
        return idex.load_dual(toolhead, config, MACHINE, "x")
    return LinearKinematics(toolhead, config, MACHINE)
