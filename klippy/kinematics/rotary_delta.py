"""kinematics: rotary_delta — three upper arms turned by shoulders, each holding the head by a lower arm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import stepper
from kinematics.axes import ZLimits, axes_of
from kinematics.delta_calibration import Calibration, rotary_delta
from kinematics.delta_limits import lower_meeting_point
from lookahead import Coord, Move

DEFAULT_ANGLES = {"a": 30.0, "b": 150.0, "c": 270.0}
# Homing assumes the head at most this far below z = 0: much lower may be out of the arms' reach.
HOMING_START_Z_MM = -1.0
REACH_STEP_MM = 0.5
REACH_DIRECTIONS = [math.radians(angle) for angle in range(0, 181, 3)]
# Cosine of the angle at the shoulder between upper arm and head. At 1 the arm is stretched: the motors would have to
# turn infinitely fast.
STRETCHED = 0.9999


@dataclass(frozen=True, slots=True)
class Arm:
    """One arm: direction of its shoulder (rad), lengths (mm)."""

    angle: float
    upper: float
    lower: float

    def reaches(self, along: float, across: float, below: float) -> bool:
        """Whether the head can be there: seen from the shoulder outward, sideways, downward (mm)."""
        distance2 = along**2 + below**2
        cosine = (distance2 + across**2 + self.upper**2 - self.lower**2) / (
            2.0 * self.upper * math.sqrt(distance2)
        )
        return abs(cosine) < STRETCHED

    def elbow(self, radius: float, height: float, turned: float) -> list[float]:
        """Place of the elbow with the upper arm `turned` radians above the horizontal."""
        out = radius + self.upper * math.cos(turned)
        return [
            out * math.cos(self.angle),
            out * math.sin(self.angle),
            height + self.upper * math.sin(turned),
        ]


def _calibrated(section: Any, name: str, default_mm: float) -> float:
    """Length of an arm; upper_arm and lower_arm are what Klipper's calibration has saved, and go before the others."""
    length_mm = section.getfloat(f"{name}_length", default_mm, above=0.0)
    return float(section.getfloat(name, length_mm, above=0.0))


class RotaryDeltaKinematics:
    """Limits, homing and positions of a rotary delta."""

    def __init__(self, toolhead: Any, config: Any) -> None:
        sections = [config.getsection(f"stepper_{name}") for name in "abc"]
        kind = {"need_position_minmax": False, "units_in_radians": True}
        first = stepper.LookupRail(sections[0], **kind)
        endstop_z = first.get_homing_info().position_endstop
        others = [stepper.LookupRail(s, default_position_endstop=endstop_z, **kind) for s in sections[1:]]
        self.rails = [first, *others]
        self.z_limits = ZLimits.read(config, toolhead, with_accel=False)
        self.shoulder_radius = config.getfloat("shoulder_radius", above=0.0)
        self.shoulder_height = config.getfloat("shoulder_height", above=0.0)
        self.min_z = config.getfloat("minimum_z_position", 0.0, maxval=endstop_z)
        upper = sections[0].getfloat("upper_arm_length", above=0.0)
        lower = sections[0].getfloat("lower_arm_length", above=0.0)
        self.arms = [
            Arm(
                math.radians(s.getfloat("angle", DEFAULT_ANGLES[name])),
                _calibrated(s, "upper_arm", upper),
                _calibrated(s, "lower_arm", lower),
            )
            for name, s in zip("abc", sections, strict=True)
        ]
        for rail, arm in zip(self.rails, self.arms, strict=True):
            rail.setup_itersolve(
                "rotary_delta_stepper_alloc",
                self.shoulder_radius, self.shoulder_height, arm.angle, arm.upper, arm.lower,
            )  # fmt: skip
            rail.set_trapq(toolhead.get_trapq())
        endstops = [
            r.get_steppers()[0].calc_position_from_coord((0.0, 0.0, r.get_homing_info().position_endstop))
            for r in self.rails
        ]
        self.home_position = self._head_at(endstops)
        self.max_z = min(r.get_homing_info().position_endstop for r in self.rails)
        self.max_r2 = self._reach() ** 2
        self.homed = False

    def _reach(self) -> float:
        """Largest radius at which all arms reach in every direction, at minimum and maximum z.

        The worst direction depends on the arms. Opposite to a shoulder its arm is stretched farthest; across from
        it the lower arm leans sideways and is shorter in the plane of the upper one.
        """
        radius = 0.0
        while radius < max(arm.upper + arm.lower for arm in self.arms) and self._all_reach(
            radius + REACH_STEP_MM
        ):
            radius += REACH_STEP_MM
        return radius

    def _all_reach(self, radius: float) -> bool:
        return all(
            arm.reaches(radius * math.cos(turned) - self.shoulder_radius, radius * math.sin(turned), below)
            for below in (self.shoulder_height - self.min_z, self.shoulder_height - self.max_z)
            for turned in REACH_DIRECTIONS
            for arm in self.arms
        )

    def get_steppers(self) -> list[stepper.MCU_stepper]:
        return [s for rail in self.rails for s in rail.get_steppers()]

    def _head_at(self, turned: Sequence[float]) -> list[float]:
        return lower_meeting_point(
            [
                (arm.elbow(self.shoulder_radius, self.shoulder_height, angle), arm.lower**2)
                for arm, angle in zip(self.arms, turned, strict=True)
            ]
        )

    def get_calibration(self) -> Calibration:
        """What DELTA_CALIBRATE may change."""
        parameters = {"radius": self.shoulder_radius, "height": self.shoulder_height}
        for name, arm, rail in zip("abc", self.arms, self.rails, strict=True):
            parameters[f"angle_{name}"] = math.degrees(arm.angle)
            parameters |= {f"upper_{name}": arm.upper, f"lower_{name}": arm.lower}
            parameters[f"endstop_{name}"] = rail.get_homing_info().position_endstop
        return rotary_delta(parameters, [rail.get_steppers()[0].get_step_dist() for rail in self.rails])

    def calc_position(self, stepper_positions: dict[str, float]) -> list[float]:
        """x, y, z (mm) from the angles (rad) by stepper name."""
        return self._head_at([stepper_positions[rail.get_steppers()[0].get_name()] for rail in self.rails])

    def set_position(self, newpos: Sequence[float], homing_axes: Sequence[int] | str = ()) -> None:
        for rail in self.rails:
            rail.set_position(newpos)
        if set(axes_of(homing_axes)) == {0, 1, 2}:
            self.homed = True

    def clear_homing_state(self, clear_axes: Sequence[int] | str) -> None:
        if axes_of(clear_axes):
            self.homed = False

    def home(self, homing_state: Any) -> None:
        homing_state.set_axes([0, 1, 2])
        forcepos = [*self.home_position[:2], HOMING_START_Z_MM]
        homing_state.home_rails(self.rails, [*forcepos, None], [*self.home_position, None])

    def check_move(self, move: Move) -> None:
        """Raise if the move leaves the reachable cylinder; slow down moves along z."""
        x, y, z, _ = move.end_pos
        if not self.homed:
            raise move.move_error("Must home first")
        at_home = all(abs(p - q) < 1e-6 for p, q in zip((x, y, z), self.home_position, strict=True))
        if not at_home and (x * x + y * y > self.max_r2 or not self.min_z <= z <= self.max_z):
            raise move.move_error()
        self.z_limits.slow_down(move)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        reach = math.sqrt(self.max_r2)
        return {
            "homed_axes": "xyz" if self.homed else "",
            "axis_minimum": Coord(-reach, -reach, self.min_z, 0.0),
            "axis_maximum": Coord(reach, reach, self.max_z, 0.0),
        }


def load_kinematics(toolhead: Any, config: Any) -> RotaryDeltaKinematics:
    return RotaryDeltaKinematics(toolhead, config)
