"""kinematics: cartesian — each of x, y, z is driven by its own rail."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import stepper
from lookahead import Coord, Move

AXIS_NAMES = "xyz"
# An axis that is not homed allows no position at all: an empty range.
UNHOMED = (1.0, -1.0)
# A homing move is planned this much longer than the axis, to reach the endstop from anywhere.
HOMING_OVERTRAVEL = 1.5


def axes_of(names_or_indexes: Sequence[int] | str) -> list[int]:
    """Axis numbers from 'xz' or (0, 2)."""
    return [AXIS_NAMES.index(a) if isinstance(a, str) else a for a in names_or_indexes]


class CartKinematics:
    """Limits, homing and positions of a cartesian machine."""

    def __init__(self, toolhead: Any, config: Any) -> None:
        self.printer = config.get_printer()
        self.rails = [stepper.LookupMultiRail(config.getsection(f"stepper_{axis}")) for axis in AXIS_NAMES]
        for rail, axis in zip(self.rails, AXIS_NAMES, strict=True):
            rail.setup_itersolve("cartesian_stepper_alloc", axis.encode())
            rail.set_trapq(toolhead.get_trapq())
        max_velocity, max_accel = toolhead.get_max_velocity()
        self.max_z_velocity = config.getfloat("max_z_velocity", max_velocity, above=0.0, maxval=max_velocity)
        self.max_z_accel = config.getfloat("max_z_accel", max_accel, above=0.0, maxval=max_accel)
        self.limits = [UNHOMED] * 3
        ranges = [rail.get_range() for rail in self.rails]
        self.axes_min = Coord(ranges[0][0], ranges[1][0], ranges[2][0], 0.0)
        self.axes_max = Coord(ranges[0][1], ranges[1][1], ranges[2][1], 0.0)

    def get_steppers(self) -> list[stepper.MCU_stepper]:
        return [s for rail in self.rails for s in rail.get_steppers()]

    def calc_position(self, stepper_positions: dict[str, float]) -> list[float]:
        """x, y, z (mm) from the positions of the steppers by name."""
        return [stepper_positions[rail.get_steppers()[0].get_name()] for rail in self.rails]

    def set_position(self, newpos: Sequence[float], homing_axes: Sequence[int] | str = ()) -> None:
        for rail in self.rails:
            rail.set_position(newpos)
        for axis in axes_of(homing_axes):
            self.limits[axis] = self.rails[axis].get_range()

    def clear_homing_state(self, clear_axes: Sequence[int] | str) -> None:
        """Forget that these axes are homed."""
        for axis in axes_of(clear_axes):
            self.limits[axis] = UNHOMED

    def home(self, homing_state: Any) -> None:
        for axis in homing_state.get_axes():
            self.home_axis(homing_state, axis, self.rails[axis])

    def home_axis(self, homing_state: Any, axis: int, rail: stepper.GenericPrinterRail) -> None:
        position_min, position_max = rail.get_range()
        info = rail.get_homing_info()
        homepos: list[float | None] = [None] * 4
        forcepos = list(homepos)
        homepos[axis] = info.position_endstop
        if info.positive_dir:
            forcepos[axis] = info.position_endstop - HOMING_OVERTRAVEL * (
                info.position_endstop - position_min
            )
        else:
            forcepos[axis] = info.position_endstop + HOMING_OVERTRAVEL * (
                position_max - info.position_endstop
            )
        homing_state.home_rails([rail], forcepos, homepos)

    def _refuse(self, move: Move) -> None:
        for axis in range(3):
            low, high = self.limits[axis]
            if move.axes_d[axis] and not low <= move.end_pos[axis] <= high:
                if low > high:
                    raise move.move_error("Must home axis first")
                raise move.move_error()

    def check_move(self, move: Move) -> None:
        """Raise if the move leaves the axes' range; slow it down if z limits it."""
        x, y, z, _ = move.end_pos
        (x_min, x_max), (y_min, y_max), (z_min, z_max) = self.limits
        if not (x_min <= x <= x_max and y_min <= y <= y_max):
            self._refuse(move)
        dz = move.axes_d[2]
        if not dz:
            return
        if not z_min <= z <= z_max:
            self._refuse(move)
        stretch = move.move_d / abs(dz)  # path length per mm of z
        move.limit_speed(self.max_z_velocity * stretch, self.max_z_accel * stretch)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        homed = [name for name, (low, high) in zip(AXIS_NAMES, self.limits, strict=True) if low <= high]
        return {"homed_axes": "".join(homed), "axis_minimum": self.axes_min, "axis_maximum": self.axes_max}


def load_kinematics(toolhead: Any, config: Any) -> CartKinematics:
    return CartKinematics(toolhead, config)
