"""What the machines have in common: limits and homing of three axes, and those with a fixed mix of axes per motor.

    LinearMachine table:  rail of axis | solver of its steppers | how x, y, z follow from the three rail positions

An endstop stops every motor that its axis turns: on a corexy both motors stop when x or y triggers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import chelper
import stepper
from lookahead import Coord, Move, done_in_c
from motionlimits import ACCEL, SPEED

AXIS_NAMES = "xyz"
# An axis that is not homed allows no position at all: an empty range.
UNHOMED = (1.0, -1.0)
# A homing move is planned this much longer than the axis, to reach the endstop from anywhere.
HOMING_OVERTRAVEL = 1.5


def axes_of(names_or_indexes: Sequence[int] | str) -> list[int]:
    """Axis numbers from 'xz' or (0, 2)."""
    return [AXIS_NAMES.index(a) if isinstance(a, str) else a for a in names_or_indexes]


@dataclass(frozen=True, slots=True)
class ZLimits:
    """Speed (mm/s) and acceleration (mm/s^2) along z."""

    velocity: float
    accel: float

    @staticmethod
    def read(config: Any, toolhead: Any, with_accel: bool = True) -> ZLimits:
        max_velocity, max_accel = toolhead.get_max_velocity()
        velocity = config.getfloat(
            "max_z_velocity", max_velocity, minval=SPEED["minval"], maxval=max_velocity
        )
        if not with_accel:
            return ZLimits(velocity, max_accel)
        accel = config.getfloat("max_z_accel", max_accel, minval=ACCEL["minval"], maxval=max_accel)
        return ZLimits(velocity, accel)

    def slow_down(self, move: Move) -> None:
        dz = move.axes_d[2]
        if dz:
            stretch = move.move_d / abs(dz)  # path length per mm of z
            move.limit_speed(self.velocity * stretch, self.accel * stretch)


def stop_all_movers(rails: Sequence[stepper.GenericPrinterRail]) -> None:
    """Let each axis' endstops stop every stepper the axis turns, of whichever rail."""
    for axis, rail in zip(AXIS_NAMES, rails, strict=True):
        own = rail.get_steppers()
        others = [s for r in rails for s in r.get_steppers() if s not in own and s.is_active_axis(axis)]
        for endstop, _name in rail.get_endstops():
            for mover in others:
                endstop.add_stepper(mover)


class BoxKinematics:
    """Three rails, each limiting and homing one axis."""

    def __init__(self, config: Any, toolhead: Any, rails: list[stepper.GenericPrinterRail]) -> None:
        self.printer = config.get_printer()
        self.rails = rails
        self.z_limits = ZLimits.read(config, toolhead)
        self.limits = [UNHOMED] * 3
        self._note_ranges()

    def _note_ranges(self) -> None:
        ranges = [rail.get_range() for rail in self.rails]
        self.axes_min = Coord(ranges[0][0], ranges[1][0], ranges[2][0], 0.0)
        self.axes_max = Coord(ranges[0][1], ranges[1][1], ranges[2][1], 0.0)

    def get_steppers(self) -> list[stepper.MCU_stepper]:
        return [s for rail in self.rails for s in rail.get_steppers()]

    def calc_position(self, stepper_positions: dict[str, float]) -> list[float]:
        """x, y, z (mm) from the positions of the steppers by name."""
        return [stepper_positions[rail.get_steppers()[0].get_name()] for rail in self.rails]

    def set_position(self, newpos: Sequence[float], homing_axes: Sequence[int] | str = ()) -> None:
        for placed in self.get_steppers():
            placed.set_position(newpos)
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

    def box(self) -> tuple[Any, ...]:
        """struct axis_box."""
        low, high = zip(*self.limits, strict=True)
        return low, high, self.z_limits.velocity, self.z_limits.accel

    def _refuse(self, move: Move) -> None:
        for axis in range(3):
            low, high = self.limits[axis]
            if move.axes_d[axis] and not low <= move.end_pos[axis] <= high:
                if low > high:
                    raise move.move_error("Must home axis first")
                raise move.move_error()

    @done_in_c
    def check_move(self, move: Move) -> None:
        """Raise if the move leaves the axes' range; slow it down if z limits it."""
        if not chelper.get_ffi()[1].move_check_box(move.record, [self.box()]):
            self._refuse(move)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        homed = [name for name, (low, high) in zip(AXIS_NAMES, self.limits, strict=True) if low <= high]
        return {"homed_axes": "".join(homed), "axis_minimum": self.axes_min, "axis_maximum": self.axes_max}


Mix = tuple[str, bytes]  # solver's name and its argument


@dataclass(frozen=True, slots=True)
class LinearMachine:
    """How the motors of the rails x, y and z follow the axes, and back."""

    solvers: tuple[Mix, Mix, Mix]
    position: Callable[[float, float, float], list[float]]


class LinearKinematics(BoxKinematics):
    """A machine described by a LinearMachine."""

    def __init__(self, toolhead: Any, config: Any, machine: LinearMachine) -> None:
        rails = [stepper.LookupMultiRail(config.getsection(f"stepper_{axis}")) for axis in AXIS_NAMES]
        for rail, solver in zip(rails, machine.solvers, strict=True):
            rail.setup_itersolve(*solver)
            rail.set_trapq(toolhead.get_trapq())
        stop_all_movers(rails)
        self._machine = machine
        super().__init__(config, toolhead, rails)

    def calc_position(self, stepper_positions: dict[str, float]) -> list[float]:
        return self._machine.position(*super().calc_position(stepper_positions))
