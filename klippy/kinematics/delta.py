"""kinematics: delta — three vertical towers whose carriages hold the head by arms of fixed length.

A carriage stands sqrt(arm^2 - d^2) above the head, d being the head's horizontal distance to the tower.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import stepper
from kinematics.axes import HOMING_OVERTRAVEL, ZLimits, axes_of
from kinematics.delta_calibration import Calibration, linear_delta
from kinematics.delta_limits import SLOW_RATIO, lower_meeting_point, slow_reach
from lookahead import Coord, Move

DEFAULT_ANGLES = {"a": 210.0, "b": 330.0, "c": 90.0}


@dataclass(frozen=True, slots=True)
class Tower:
    """One tower: place and arm length in mm; endstop: height of the carriage when it triggers."""

    x: float
    y: float
    arm: float
    endstop: float

    def height(self, x: float, y: float) -> float:
        """Of the carriage above the head."""
        return math.sqrt(max(0.0, self.arm**2 - (x - self.x) ** 2 - (y - self.y) ** 2))


class DeltaKinematics:
    """Limits, homing and positions of a linear delta."""

    def __init__(self, toolhead: Any, config: Any) -> None:
        sections = [config.getsection(f"stepper_{name}") for name in "abc"]
        first = stepper.LookupMultiRail(sections[0], need_position_minmax=False)
        endstop_z = first.get_homing_info().position_endstop
        self.rails = [
            first,
            *(
                stepper.LookupMultiRail(s, need_position_minmax=False, default_position_endstop=endstop_z)
                for s in sections[1:]
            ),
        ]
        self.z_limits = ZLimits.read(config, toolhead)
        self.min_z = config.getfloat("minimum_z_position", 0.0, maxval=endstop_z)
        self.radius = config.getfloat("delta_radius", above=0.0)
        self.print_radius = config.getfloat("print_radius", self.radius, above=0.0)
        self.towers = self._read_towers(sections)
        for rail, tower in zip(self.rails, self.towers, strict=True):
            rail.setup_itersolve("delta_stepper_alloc", tower.arm**2, tower.x, tower.y)
            rail.set_trapq(toolhead.get_trapq())
        self.home_position = self._head_at([t.endstop for t in self.towers])
        self.max_z = min(rail.get_homing_info().position_endstop for rail in self.rails)
        # below this no carriage can reach its endstop, wherever the head is
        self.flat_z = min(t.endstop - t.arm for t in self.towers)
        self._set_slow_zones()
        self.homed = False

    def _read_towers(self, sections: Sequence[Any]) -> list[Tower]:
        default_arm = sections[0].getfloat("arm_length", above=self.radius)
        towers = []
        for name, section, rail in zip("abc", sections, self.rails, strict=True):
            arm = section.getfloat("arm_length", default_arm, above=self.radius)
            angle = math.radians(section.getfloat("angle", DEFAULT_ANGLES[name]))
            endstop = rail.get_homing_info().position_endstop + math.sqrt(arm**2 - self.radius**2)
            towers.append(Tower(self.radius * math.cos(angle), self.radius * math.sin(angle), arm, endstop))
        return towers

    def _set_slow_zones(self) -> None:
        """(radius squared, share of the limits) from the centre outwards."""
        arm = min(t.arm for t in self.towers)
        edges = [slow_reach(arm, ratio) - self.radius for ratio in (SLOW_RATIO, 2.0 * SLOW_RATIO)]
        self.slow_r2, self.very_slow_r2 = (max(0.0, edge) ** 2 for edge in edges)
        self.max_r2 = max(0.0, min(self.print_radius, arm - self.radius)) ** 2

    def get_steppers(self) -> list[stepper.MCU_stepper]:
        return [s for rail in self.rails for s in rail.get_steppers()]

    def _head_at(self, carriages: Sequence[float]) -> list[float]:
        return lower_meeting_point(
            [((t.x, t.y, z), t.arm**2) for t, z in zip(self.towers, carriages, strict=True)]
        )

    def get_calibration(self) -> Calibration:
        """What DELTA_CALIBRATE may change."""
        parameters = {"radius": self.radius}
        for name, tower, rail in zip("abc", self.towers, self.rails, strict=True):
            parameters[f"angle_{name}"] = math.degrees(math.atan2(tower.y, tower.x)) % 360.0
            parameters[f"arm_{name}"] = tower.arm
            parameters[f"endstop_{name}"] = rail.get_homing_info().position_endstop
        return linear_delta(parameters, [rail.get_steppers()[0].get_step_dist() for rail in self.rails])

    def calc_position(self, stepper_positions: dict[str, float]) -> list[float]:
        """x, y, z (mm) from the heights of the carriages by stepper name."""
        return self._head_at([stepper_positions[rail.get_steppers()[0].get_name()] for rail in self.rails])

    def set_position(self, newpos: Sequence[float], homing_axes: Sequence[int] | str = ()) -> None:
        for rail in self.rails:
            rail.set_position(newpos)
        if set(axes_of(homing_axes)) == {0, 1, 2}:
            self.homed = True

    def clear_homing_state(self, clear_axes: Sequence[int] | str) -> None:
        """The three are homed together, so one lost is all lost."""
        if axes_of(clear_axes):
            self.homed = False

    def home(self, homing_state: Any) -> None:
        """All carriages up to their endstops, whichever axes are asked for."""
        homing_state.set_axes([0, 1, 2])
        forcepos = list(self.home_position)
        forcepos[2] = -HOMING_OVERTRAVEL * math.sqrt(max(t.arm for t in self.towers) ** 2 - self.radius**2)
        homing_state.home_rails(self.rails, [*forcepos, None], [*self.home_position, None])

    def _carriage_passes_endstop(self, move: Move) -> bool:
        """The height of a carriage along a straight line has one maximum: look for it between the ends."""
        (x0, y0, z0, _), (dx, dy, dz, _) = move.start_pos, move.axes_d
        for tower in self.towers:
            limit = tower.endstop + 1e-6
            low, high = 0.0, 1.0
            for _ in range(30):
                third = (high - low) / 3.0
                a, b = low + third, high - third
                ha = z0 + a * dz + tower.height(x0 + a * dx, y0 + a * dy)
                hb = z0 + b * dz + tower.height(x0 + b * dx, y0 + b * dy)
                if ha < hb:
                    low = a
                else:
                    high = b
            for t in (low, 1.0):
                if z0 + t * dz + tower.height(x0 + t * dx, y0 + t * dy) > limit:
                    return True
        return False

    def check_move(self, move: Move) -> None:
        """Raise if the head or a carriage would leave its range; slow down where carriages are fast."""
        x, y, z, _ = move.end_pos
        if not self.homed:
            raise move.move_error("Must home first")
        r2 = x * x + y * y
        if r2 > self.max_r2 or not self.min_z <= z <= max(self.max_z, self.home_position[2]):
            raise move.move_error()
        if z > self.flat_z and self._carriage_passes_endstop(move):
            raise move.move_error()
        self.z_limits.slow_down(move)
        r2 = max(r2, move.start_pos[0] ** 2 + move.start_pos[1] ** 2)
        if r2 > self.slow_r2:
            share = 0.25 if r2 > self.very_slow_r2 else 0.5
            max_velocity, max_accel = move.toolhead.get_max_velocity()
            move.limit_speed(max_velocity * share, max_accel * share)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        reach = math.sqrt(self.max_r2)
        return {
            "homed_axes": "xyz" if self.homed else "",
            "axis_minimum": Coord(-reach, -reach, self.min_z, 0.0),
            "axis_maximum": Coord(reach, reach, self.max_z, 0.0),
            "cone_start_z": self.flat_z,
        }


def load_kinematics(toolhead: Any, config: Any) -> DeltaKinematics:
    return DeltaKinematics(toolhead, config)
