"""kinematics: polar — a turning bed, and an arm that moves the head away from its centre.

    angle of the bed = atan2(y, x)        place on the arm = sqrt(x^2 + y^2)

Close to the centre the bed must turn fast: moves that pass it are slowed down, and one that leaves the centre in
another direction than the bed stands in is refused, since no speed is low enough for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import stepper
from kinematics.axes import ZLimits, axes_of
from lookahead import Coord, Move

# The bed turns at most this fast (rad/s) unless max_angular_velocity says otherwise.
BED_SPEED_MAX = 50.0
# Within this of the centre a move counts as going through it (mm).
CENTRE_MM = 0.02


class PolarKinematics:
    """Limits, homing and positions of a polar machine."""

    def __init__(self, toolhead: Any, config: Any) -> None:
        self.bed = stepper.PrinterStepper(config.getsection("stepper_bed"), units_in_radians=True)
        self.arm = stepper.LookupMultiRail(config.getsection("stepper_arm"))
        self.z_rail = stepper.LookupMultiRail(config.getsection("stepper_z"))
        self.bed.setup_itersolve("polar_stepper_alloc", b"a")
        self.arm.setup_itersolve("polar_stepper_alloc", b"r")
        self.z_rail.setup_itersolve("cartesian_stepper_alloc", b"z")
        for placed in self.get_steppers():
            placed.set_trapq(toolhead.get_trapq())
        self.z_limits = ZLimits.read(config, toolhead)
        self.bed_speed_max = config.getfloat("max_angular_velocity", BED_SPEED_MAX, above=0.0)
        self.max_r = self.arm.get_range()[1]
        self.homed_xy = self.homed_z = False

    def get_steppers(self) -> list[stepper.MCU_stepper]:
        return [self.bed, *self.arm.get_steppers(), *self.z_rail.get_steppers()]

    def calc_position(self, stepper_positions: dict[str, float]) -> list[float]:
        """x, y, z (mm) from the bed's angle (rad) and the places on arm and z, by stepper name."""
        angle = stepper_positions[self.bed.get_name()]
        radius = stepper_positions[self.arm.get_steppers()[0].get_name()]
        z = stepper_positions[self.z_rail.get_steppers()[0].get_name()]
        return [radius * math.cos(angle), radius * math.sin(angle), z]

    def set_position(self, newpos: Sequence[float], homing_axes: Sequence[int] | str = ()) -> None:
        for placed in self.get_steppers():
            placed.set_position(newpos)
        axes = axes_of(homing_axes)
        if 2 in axes:
            self.homed_z = True
        if 0 in axes and 1 in axes:
            self.homed_xy = True

    def clear_homing_state(self, clear_axes: Sequence[int] | str) -> None:
        axes = axes_of(clear_axes)
        if 2 in axes:
            self.homed_z = False
        if 0 in axes or 1 in axes:
            self.homed_xy = False

    def home(self, homing_state: Any) -> None:
        """x and y are homed together, by the arm; the bed's angle is then called 0."""
        wanted = homing_state.get_axes()
        axes = ([0, 1] if 0 in wanted or 1 in wanted else []) + ([2] if 2 in wanted else [])
        homing_state.set_axes(axes)
        if 0 in axes:
            start, end = self._homing_way(self.arm)
            homing_state.home_rails([self.arm], [start, 0.0, None, None], [end, 0.0, None, None])
        if 2 in axes:
            start, end = self._homing_way(self.z_rail)
            homing_state.home_rails([self.z_rail], [None, None, start, None], [None, None, end, None])

    @staticmethod
    def _homing_way(rail: stepper.GenericPrinterRail) -> tuple[float, float]:
        """From the far end of the rail, no farther: a place on the arm has no negative side."""
        info = rail.get_homing_info()
        low, high = rail.get_range()
        return low if info.positive_dir else high, info.position_endstop

    def _check_centre(self, move: Move) -> None:
        """Slow down near the centre; see the top of this file."""
        (x0, y0, _, _), (dx, dy, _, _) = move.start_pos, move.axes_d
        d2 = dx * dx + dy * dy
        along = -(x0 * dx + y0 * dy) / d2
        t = min(1.0, max(0.0, along))
        nearest = math.hypot(x0 + t * dx, y0 + t * dy)
        turns = abs(x0 * dy - y0 * dx) > 1e-9  # else: along a ray, the bed rests
        if not turns:
            away_from_centre = math.hypot(x0, y0) < CENTRE_MM
            if 0.0 < along < 1.0 or (away_from_centre and (dy or dx < 0.0)):
                raise move.move_error(f"Move through the centre of the bed, within {CENTRE_MM:g} mm")
            return
        if nearest < CENTRE_MM:
            raise move.move_error(f"Move through the centre of the bed, within {CENTRE_MM:g} mm")
        speed = self.bed_speed_max * nearest * move.move_d / math.sqrt(d2)
        move.limit_speed(speed, move.accel)

    def check_move(self, move: Move) -> None:
        x, y, z, _ = move.end_pos
        dx, dy, dz, _ = move.axes_d
        if dx or dy:
            if not self.homed_xy:
                raise move.move_error("Must home axis first")
            if x * x + y * y > self.max_r**2:
                raise move.move_error()
            self._check_centre(move)
        if dz:
            low, high = self.z_rail.get_range()
            if not self.homed_z:
                raise move.move_error("Must home axis first")
            if not low <= z <= high:
                raise move.move_error()
            self.z_limits.slow_down(move)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        low, high = self.z_rail.get_range()
        return {
            "homed_axes": ("xy" if self.homed_xy else "") + ("z" if self.homed_z else ""),
            "axis_minimum": Coord(-self.max_r, -self.max_r, low, 0.0),
            "axis_maximum": Coord(self.max_r, self.max_r, high, 0.0),
        }


def load_kinematics(toolhead: Any, config: Any) -> PolarKinematics:
    return PolarKinematics(toolhead, config)
