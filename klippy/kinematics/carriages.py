"""Machines described by carriages: each motor moves a mix of carriages, and an axis may have several of them (IDEX).

    motor = sum of coefficient * place of carriage
    place of carriage = scale * axis + offset

A carriage that is in use has scale 1 and offset 0. On an axis with more, the others rest (scale 0, the place is the
offset), copy it (scale 1) or mirror it (scale -1). Every mode is such a pair of numbers, so a motor is always
a fixed mix of x, y, z plus a constant: the solver of the linear machines, and the range of an axis stays an interval.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import chelper
import stepper
from kinematics.axes import AXIS_NAMES, UNHOMED, BoxKinematics, axes_of

INACTIVE, PRIMARY, COPY, MIRROR = "INACTIVE", "PRIMARY", "COPY", "MIRROR"
# A motor mix that turns less than this per mm of any axis can not place the axes (mixes are of the order of 1).
SMALLEST_PIVOT = 1e-6


class CarriageRail(stepper.GenericPrinterRail):
    """The range and endstops of a carriage; the motors are given to it afterwards."""

    def get_name(self, short: bool = False) -> str:
        name = self._config_name
        return name.split()[-1] if short and " " in name else super().get_name(short)

    def add_endstop(self, pin: str, name: str, config: Any) -> Any:
        return self._lookup_endstop(pin, name, config)

    def attach(self, motor: stepper.MCU_stepper, endstop: Any) -> None:
        """The motor takes part in the rail's motion and is stopped by `endstop`."""
        if motor not in self.steppers:
            self.steppers.append(motor)
        if motor not in endstop.get_steppers():
            endstop.add_stepper(motor)


@dataclass(eq=False, slots=True)
class Carriage:
    """One carriage: `place` (mm) = scale * axis + offset."""

    name: str
    axis: int
    rail: stepper.GenericPrinterRail
    endstop: Any
    mode: str = PRIMARY
    scale: float = 1.0
    offset: float = 0.0
    homed: bool = False
    follows: Carriage | None = None  # an extra carriage moves as this one does

    def main(self) -> Carriage:
        return self if self.follows is None else self.follows

    def place(self, axis_position: float) -> float:
        return self.scale * axis_position + self.offset

    def axis_range(self) -> tuple[float, float]:
        """Positions of the axis (mm) at which this carriage is within its rail."""
        if not self.homed:
            return UNHOMED
        low, high = self.rail.get_range()
        if self.mode == MIRROR:
            return self.offset - high, self.offset - low
        if self.mode == COPY:
            return low - self.offset, high - self.offset
        return low, high


@dataclass(eq=False, slots=True)
class Drive:
    """A motor and what it moves."""

    motor: stepper.MCU_stepper
    coefficients: dict[Carriage, float]

    def mix(self) -> tuple[float, float, float, float]:
        """(x, y, z, constant) of the motor's position in the modes of now."""
        row = [0.0, 0.0, 0.0]
        constant = 0.0
        for carriage, coefficient in self.coefficients.items():
            main = carriage.main()
            row[carriage.axis] += coefficient * main.scale
            constant += coefficient * main.offset
        return row[0], row[1], row[2], constant


@dataclass(eq=False, slots=True)
class CarriageGroup:
    """The carriages of one axis. `safe_mm`: minimum distance of two of them, 0: not watched."""

    axis: int
    carriages: tuple[Carriage, ...]
    safe_mm: dict[frozenset[Carriage], float]

    def active(self) -> Carriage:
        return next(c for c in self.carriages if c.mode == PRIMARY)

    def upwards(self) -> list[Carriage]:
        """As they stand on the axis."""

        def height(carriage: Carriage) -> tuple[float, float]:
            return sum(carriage.rail.get_range()), carriage.rail.get_homing_info().position_endstop

        return sorted(self.carriages, key=height)

    def home_order(self) -> list[Carriage]:
        """The primary carriage first, then the dual ones; but before one that it is beyond where both home to."""
        order: list[Carriage] = []
        for carriage in self.carriages:
            place = next((i for i, other in enumerate(order) if _is_beyond(carriage, other)), len(order))
            order.insert(place, carriage)
        return order

    def limits(self) -> tuple[float, float]:
        """Range of the axis (mm) in which all that moves stays on its rail and clear of the others."""
        low, high = self.active().axis_range()
        homed = [c for c in self.upwards() if c.homed]
        if low > high:
            return low, high
        for follower in homed:
            if follower.mode in (COPY, MIRROR):
                follower_low, follower_high = follower.axis_range()
                low, high = max(low, follower_low), min(high, follower_high)
        for lower, upper in itertools.combinations(homed, 2):
            safe_mm = self.safe_mm.get(frozenset((lower, upper)), 0.0)
            # distance = slope * axis + rest
            slope, rest = upper.scale - lower.scale, upper.offset - lower.offset
            if safe_mm and slope < 0.0:
                high = min(high, (rest - safe_mm) / -slope)
            elif safe_mm and slope > 0.0:
                low = max(low, (safe_mm - rest) / slope)
        return low, high


def _is_beyond(carriage: Carriage, other: Carriage) -> bool:
    """Both home in the same direction, `carriage` farther."""
    one, two = other.rail.get_homing_info(), carriage.rail.get_homing_info()
    beyond = two.position_endstop - one.position_endstop
    return one.positive_dir == two.positive_dir and ((beyond > 0.0) if one.positive_dir else (beyond < 0.0))


def solve(rows: Sequence[Sequence[float]], right: Sequence[float], pivot_min: float) -> list[float]:
    """Solution of a square system by elimination with pivots; ValueError if there is none.

    Not numpy's: that takes 15 MB of the host's memory, for four unknowns at most.
    """
    work = [[*row, value] for row, value in zip(rows, right, strict=True)]
    for column in range(len(work)):
        pivot = max(range(column, len(work)), key=lambda r: abs(work[r][column]))
        if abs(work[pivot][column]) <= pivot_min:
            raise ValueError("the points determine no surface")
        work[column], work[pivot] = work[pivot], work[column]
        for row, values in enumerate(work):
            if row != column:
                share = values[column] / work[column][column]
                work[row] = [a - share * b for a, b in zip(values, work[column], strict=True)]
    return [row[-1] / row[column] for column, row in enumerate(work)]


def solve_axes(rows: Sequence[tuple[Sequence[float], float]]) -> list[float] | None:
    """x, y, z with the smallest squared error of `row . xyz = value`; None if the rows do not determine them."""
    system = [[math.fsum(r[i] * r[j] for r, _ in rows) for j in range(3)] for i in range(3)]
    right = [math.fsum(r[i] * value for r, value in rows) for i in range(3)]
    try:
        return solve(system, right, SMALLEST_PIVOT)
    except ValueError:
        return None


@dataclass(frozen=True, slots=True)
class CarriageMachine:
    """What a configuration describes: a carriage for each axis, several on some, the motors."""

    primary: tuple[Carriage, Carriage, Carriage]
    drives: list[Drive]
    groups: dict[int, CarriageGroup] = field(default_factory=dict)  # by axis


class CarriageKinematics(BoxKinematics):
    """Limits, homing and positions of a CarriageMachine."""

    def __init__(self, toolhead: Any, config: Any, machine: CarriageMachine) -> None:
        self.machine = machine
        self.groups = machine.groups
        self.toolhead = toolhead
        self._ffi, self._lib = chelper.get_ffi()
        self._keeps_grid = False
        self._homing_axes: set[int] = set()
        for group in self.groups.values():
            for resting in group.carriages[1:]:
                resting.mode, resting.scale = INACTIVE, 0.0
        for drive in machine.drives:
            drive.motor.setup_itersolve("generic_cartesian_stepper_alloc", 0.0, 0.0, 0.0)
            drive.motor.set_trapq(toolhead.get_trapq())
        self._set_mixes()
        super().__init__(config, toolhead, [c.rail for c in machine.primary])

    # -- motors --

    def _set_mixes(self) -> None:
        for drive in self.machine.drives:
            self._lib.itersolve_set_mix(drive.motor.get_stepper_kinematics(), *drive.mix())

    def get_steppers(self) -> list[stepper.MCU_stepper]:
        return [drive.motor for drive in self.machine.drives]

    def solve(self, stepper_positions: dict[str, float]) -> list[float] | None:
        """x, y, z (mm); None if the motors do not determine them."""
        rows = []
        for drive in self.machine.drives:
            x, y, z, constant = drive.mix()
            rows.append(((x, y, z), stepper_positions[drive.motor.get_name()] - constant))
        return solve_axes(rows)

    def calc_position(self, stepper_positions: dict[str, float]) -> list[float]:
        place = self.solve(stepper_positions)
        if place is None:
            raise self.printer.command_error(
                "The motors as they are set now do not determine x, y and z (SET_STEPPER_CARRIAGES)"
            )
        return place

    # -- carriages --

    def active(self, axis: int) -> Carriage:
        """The carriage that executes the moves of an axis."""
        group = self.groups.get(axis)
        return self.machine.primary[axis] if group is None else group.active()

    def _update_limits(self) -> None:
        for axis in range(3):
            group = self.groups.get(axis)
            if group is None or axis in self._homing_axes:
                self.limits[axis] = self.active(axis).axis_range()
            else:
                self.limits[axis] = group.limits()
            self.rails[axis] = self.active(axis).rail
        self._note_ranges()

    def set_position(self, newpos: Sequence[float], homing_axes: Sequence[int] | str = ()) -> None:
        for motor in self.get_steppers():
            if self._keeps_grid:
                motor.set_trapq(motor.get_trapq())  # other coordinates, but the motor's own have not changed
            else:
                motor.set_position(newpos)
        for axis in axes_of(homing_axes):
            self.active(axis).homed = True
        self._update_limits()

    def clear_homing_state(self, clear_axes: Sequence[int] | str) -> None:
        for axis in axes_of(clear_axes):
            group = self.groups.get(axis)
            for carriage in (self.machine.primary[axis],) if group is None else group.carriages:
                carriage.homed = False
        self._update_limits()

    def set_modes(
        self,
        group: CarriageGroup,
        active: Carriage,
        followers: Mapping[Carriage, str] | None = None,
        shares: Mapping[Carriage, float] | None = None,
    ) -> None:
        """From now on `active` executes the axis' moves, the followers copy or mirror them, the others rest; or they go
        the given share of each way, for a move whose ends are known to be good for them."""
        toolhead = self.toolhead
        toolhead.flush_step_generation()
        position = toolhead.get_position()
        here = {c: c.place(position[group.axis]) for c in group.carriages}
        for carriage in group.carriages:
            carriage.mode = PRIMARY if carriage is active else (followers or {}).get(carriage, INACTIVE)
            resting = (shares or {}).get(carriage, 0.0)
            carriage.scale = {PRIMARY: 1.0, INACTIVE: resting, COPY: 1.0, MIRROR: -1.0}[carriage.mode]
            carriage.offset = here[carriage] - carriage.scale * here[active]
        self._set_mixes()
        position[group.axis] = here[active]
        self._keeps_grid = True
        try:
            toolhead.set_position(position)
        finally:
            self._keeps_grid = False
        self.printer.send_event("dual_carriage:update_kinematics")

    # -- homing --

    def home(self, homing_state: Any) -> None:
        for axis in homing_state.get_axes():
            group = self.groups.get(axis)
            if group is None:
                self.home_axis(homing_state, axis, self.machine.primary[axis].rail)
            else:
                self._home_group(homing_state, group)

    def _home_group(self, homing_state: Any, group: CarriageGroup) -> None:
        """One after the other; afterwards the primary carriage is in use."""
        self._homing_axes.add(group.axis)
        try:
            for carriage in group.home_order():
                self.set_modes(group, carriage)
                self.home_axis(homing_state, group.axis, carriage.rail)
        finally:
            self._homing_axes.discard(group.axis)
            self._update_limits()
        self.set_modes(group, group.carriages[0])


def check_machine(config: Any, machine: CarriageMachine) -> None:
    """Raise unless the motors determine x, y and z whichever of the carriages are in use."""
    choices: list[dict[int, Carriage]] = [{}]
    for axis, group in machine.groups.items():
        choices = [{**choice, axis: c} for choice in choices for c in group.carriages]
    for choice in choices:
        rows = []
        for drive in machine.drives:
            row = [0.0, 0.0, 0.0]
            for carriage, coefficient in drive.coefficients.items():
                main = carriage.main()
                if choice.get(main.axis, main) is main:
                    row[main.axis] += coefficient
            rows.append((row, 0.0))
        if solve_axes(rows) is None:
            text = ", ".join(
                f"{drive.motor.get_name()}: {describe(drive.coefficients)}" for drive in machine.drives
            )
            raise config.error(
                f"The motors do not determine the position of x, y and z ({text}). Each axis needs a motor, or a "
                "combination of motors, that moves it independently of the others."
            )


def describe(coefficients: dict[Carriage, float]) -> str:
    """'carriage_x-0.5*carriage_y'."""
    text = ""
    for carriage, coefficient in coefficients.items():
        factor = "" if abs(coefficient) == 1.0 else f"{abs(coefficient):g}*"
        sign = "-" if coefficient < 0.0 else ("+" if text else "")
        text += f"{sign}{factor}{carriage.name}"
    return text


def range_shift(first: stepper.GenericPrinterRail, second: stepper.GenericPrinterRail) -> float:
    """How far the one's range is shifted against the other's, mm."""
    (low1, high1), (low2, high2) = first.get_range(), second.get_range()
    return min(abs(low1 - low2), abs(high1 - high2))


def read_safe_distance(config: Any, first: stepper.GenericPrinterRail, second: Any) -> float:
    """Option safe_distance; default: the shift of the ranges."""
    return float(config.getfloat("safe_distance", range_shift(first, second), minval=0.0))


__all__: Sequence[str] = (
    "AXIS_NAMES",
    "Carriage",
    "CarriageGroup",
    "CarriageKinematics",
    "CarriageMachine",
    "CarriageRail",
    "Drive",
)  # fmt: skip
