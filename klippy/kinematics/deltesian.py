"""kinematics: deltesian — two towers hold the head in x and z by arms; y is an axis of its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import stepper
from kinematics.axes import HOMING_OVERTRAVEL, UNHOMED, ZLimits, axes_of
from kinematics.delta_limits import SLOW_RATIO, slow_reach
from lookahead import Coord, Move

DEFAULT_MIN_ANGLE_DEG = 5.0


@dataclass(frozen=True, slots=True)
class Tower:
    """x: foot of the tower, arm: length, endstop: height of the carriage when it triggers (mm)."""

    x: float
    arm: float
    endstop: float

    def height(self, x: float) -> float:
        """Of the carriage above the head."""
        return math.sqrt(max(0.0, self.arm**2 - (x - self.x) ** 2))


class DeltesianKinematics:
    """Limits, homing and positions of a deltesian."""

    def __init__(self, toolhead: Any, config: Any) -> None:
        sections = [config.getsection(f"stepper_{name}") for name in ("left", "right")]
        left = stepper.LookupRail(sections[0], need_position_minmax=False)
        endstop_z = left.get_homing_info().position_endstop
        right = stepper.LookupRail(
            sections[1], need_position_minmax=False, default_position_endstop=endstop_z
        )
        self.columns = [left, right]
        self.y_rail = stepper.LookupMultiRail(config.getsection("stepper_y"))
        self.z_limits = ZLimits.read(config, toolhead)
        self.min_z = config.getfloat("minimum_z_position", 0.0, maxval=endstop_z)
        self.towers = self._read_towers(sections)
        for rail, tower in zip(self.columns, self.towers, strict=True):
            rail.setup_itersolve("deltesian_stepper_alloc", tower.arm**2, tower.x)
        self.y_rail.setup_itersolve("cartesian_stepper_alloc", b"y")
        for placed in self.get_steppers():
            placed.set_trapq(toolhead.get_trapq())
        self._read_limits(config)
        self.home_x, self.home_z = self._head_at([t.endstop for t in self.towers])
        self.max_z = min(r.get_homing_info().position_endstop for r in self.columns)
        self.homed_xz = False
        self.y_limits = UNHOMED

    def _read_towers(self, sections: Sequence[Any]) -> list[Tower]:
        first_arm = sections[0].getfloat("arm_length", above=0.0)
        first_x = sections[0].getfloat("arm_x_length", above=0.0)
        towers = []
        for sign, section, rail in zip((-1.0, 1.0), sections, self.columns, strict=True):
            arm_x = section.getfloat("arm_x_length", first_x, above=0.0)
            arm = section.getfloat("arm_length", first_arm, above=arm_x)
            endstop = rail.get_homing_info().position_endstop + math.sqrt(arm**2 - arm_x**2)
            towers.append(Tower(sign * arm_x, arm, endstop))
        return towers

    def _read_limits(self, config: Any) -> None:
        min_angle = config.getfloat("min_angle", DEFAULT_MIN_ANGLE_DEG, minval=0.0, below=90.0)
        left, right = self.towers
        reach = math.cos(math.radians(min_angle))
        low, high = right.x - reach * right.arm, left.x + reach * left.arm
        width = config.getfloat("print_width", None, above=0.0, maxval=max(0.0, 2.0 * min(-low, high)))
        if width is not None:
            low, high = max(low, -0.5 * width), min(high, 0.5 * width)
        if low >= high:
            raise config.error(
                "Section 'printer': with these arms no x is left; lower min_angle or check arm_length"
            )
        self.x_limits = low, high
        ratio = config.getfloat("slow_ratio", SLOW_RATIO, minval=0.0)
        self._slow = [
            (right.x - slow_reach(right.arm, r), left.x + slow_reach(left.arm, r)) if r > 0.0 else (low, high)
            for r in (ratio, 2.0 * ratio)
        ]

    def get_steppers(self) -> list[stepper.MCU_stepper]:
        return [s for rail in (*self.columns, self.y_rail) for s in rail.get_steppers()]

    def _head_at(self, carriages: Sequence[float]) -> tuple[float, float]:
        """x and z of the head: the lower point in which two circles meet."""
        a, b = self.towers
        dx, dz = b.x - a.x, carriages[1] - carriages[0]
        d2 = dx * dx + dz * dz
        along = 0.5 * (d2 + a.arm**2 - b.arm**2) / d2
        below = math.sqrt(max(0.0, a.arm**2 / d2 - along * along))
        return a.x + along * dx + below * dz, carriages[0] + along * dz - below * dx

    def calc_position(self, stepper_positions: dict[str, float]) -> list[float]:
        heights = [stepper_positions[r.get_steppers()[0].get_name()] for r in self.columns]
        x, z = self._head_at(heights)
        return [x, stepper_positions[self.y_rail.get_steppers()[0].get_name()], z]

    def set_position(self, newpos: Sequence[float], homing_axes: Sequence[int] | str = ()) -> None:
        for placed in self.get_steppers():
            placed.set_position(newpos)
        axes = axes_of(homing_axes)
        if 0 in axes and 2 in axes:
            self.homed_xz = True
        if 1 in axes:
            self.y_limits = self.y_rail.get_range()

    def clear_homing_state(self, clear_axes: Sequence[int] | str) -> None:
        axes = axes_of(clear_axes)
        if 0 in axes or 2 in axes:
            self.homed_xz = False
        if 1 in axes:
            self.y_limits = UNHOMED

    def home(self, homing_state: Any) -> None:
        """x and z are homed together at the top."""
        wanted = homing_state.get_axes()
        axes = ([0, 2] if 0 in wanted or 2 in wanted else []) + ([1] if 1 in wanted else [])
        homing_state.set_axes(axes)
        if 0 in axes:
            start = -HOMING_OVERTRAVEL * max(t.height(0.0) for t in self.towers)
            homing_state.home_rails(
                self.columns, [self.home_x, None, start, None], [self.home_x, None, self.home_z, None]
            )
        if 1 in axes:
            info = self.y_rail.get_homing_info()
            low, high = self.y_rail.get_range()
            way = (low if info.positive_dir else high) - info.position_endstop
            start = info.position_endstop + HOMING_OVERTRAVEL * way
            homing_state.home_rails(
                [self.y_rail], [None, start, None, None], [None, info.position_endstop, None, None]
            )

    def _too_high(self, x: float, z: float) -> bool:
        return any(z + t.height(x) > t.endstop + 1e-6 for t in self.towers)

    def _crosses_top(self, move: Move) -> bool:
        """A carriage is highest with its arm upright: look at the ends and where the move passes a tower's foot."""
        (x0, _, z0, _), (dx, _, dz, _) = move.start_pos, move.axes_d
        shares = [1.0, 0.25, 0.5, 0.75]
        if dx:
            shares += [t for tower in self.towers if 0.0 < (t := (tower.x - x0) / dx) < 1.0]
        return any(self._too_high(x0 + t * dx, z0 + t * dz) for t in shares)

    def check_move(self, move: Move) -> None:
        x, y, z, _ = move.end_pos
        dx, dy, dz, _ = move.axes_d
        if dy and not self.y_limits[0] <= y <= self.y_limits[1]:
            raise move.move_error("Must home axis first" if self.y_limits == UNHOMED else "Move out of range")
        if not (dx or dz):
            return
        if not self.homed_xz:
            raise move.move_error("Must home axis first")
        low, high = self.x_limits
        if not (low <= x <= high and self.min_z <= z <= max(self.max_z, self.home_z)):
            raise move.move_error()
        if self._crosses_top(move):
            raise move.move_error()
        self.z_limits.slow_down(move)
        self._slow_near_edges(move)

    def _slow_near_edges(self, move: Move) -> None:
        if not move.axes_d[0]:
            return
        ends = sorted((move.start_pos[0], move.end_pos[0]))
        shares = [
            share
            for (low, high), share in zip(self._slow, (0.5, 0.25), strict=True)
            if ends[0] < low or ends[1] > high
        ]
        if shares:
            max_velocity, max_accel = move.toolhead.get_max_velocity()
            move.limit_speed(max_velocity * shares[-1], max_accel * shares[-1])

    def get_status(self, eventtime: float) -> dict[str, Any]:
        y_low, y_high = self.y_rail.get_range()
        return {
            "homed_axes": ("xz" if self.homed_xz else "") + ("y" if self.y_limits != UNHOMED else ""),
            "axis_minimum": Coord(self.x_limits[0], y_low, self.min_z, 0.0),
            "axis_maximum": Coord(self.x_limits[1], y_high, self.max_z, 0.0),
        }


def load_kinematics(toolhead: Any, config: Any) -> DeltesianKinematics:
    return DeltesianKinematics(toolhead, config)
