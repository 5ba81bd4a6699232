"""[dual_carriage]: further carriages on an axis. SET_DUAL_CARRIAGE, SAVE_ and RESTORE_DUAL_CARRIAGE_STATE.

Printer object 'dual_carriage'. On machines with fixed axes (cartesian, hybrid) the carriages are called 0 and 1, with
generic_cartesian by their names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import stepper
from kinematics.axes import AXIS_NAMES, LinearMachine
from kinematics.carriages import (
    COPY,
    MIRROR,
    PRIMARY,
    SMALLEST_PIVOT,
    Carriage,
    CarriageGroup,
    CarriageKinematics,
    CarriageMachine,
    Drive,
    check_machine,
    read_safe_distance,
    solve_axes,
)

SECTION = "dual_carriage"
MODES = (PRIMARY, COPY, MIRROR)


@dataclass(frozen=True, slots=True)
class SavedGroup:
    """Modes of the carriages of an axis, and their places (mm; None: not homed)."""

    modes: tuple[str, ...]
    places: tuple[float | None, ...]


class DualCarriages:
    """The commands, and the status of all carriages."""

    def __init__(self, printer: Any, kin: CarriageKinematics, names: dict[str, Carriage]) -> None:
        self.printer = printer
        self.kin = kin
        self.names = names  # as CARRIAGE= names them
        self.saved: dict[str, list[SavedGroup]] = {}

    def register(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        for name, text in (
            ("SET_DUAL_CARRIAGE", "Configure the dual carriages mode"),
            ("SAVE_DUAL_CARRIAGE_STATE", "Save dual carriages modes and positions"),
            ("RESTORE_DUAL_CARRIAGE_STATE", "Restore dual carriages modes and positions"),
        ):
            gcode.register_command(name, getattr(self, f"cmd_{name}"), desc=text)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        status: dict[str, Any] = {"carriages": {name: c.mode for name, c in self.names.items()}}
        for name, carriage in self.names.items():
            if name.isdigit():
                status[f"carriage_{name}"] = carriage.mode
        return status

    def _groups(self) -> list[CarriageGroup]:
        return list(self.kin.groups.values())

    # -- commands --

    def cmd_SET_DUAL_CARRIAGE(self, gcmd: Any) -> None:
        """SET_DUAL_CARRIAGE CARRIAGE=<name> [MODE=PRIMARY|COPY|MIRROR]."""
        name = gcmd.get("CARRIAGE")
        carriage = self.names.get(name) or self.names.get(name.strip())
        if carriage is None:
            raise gcmd.error(f"Unknown carriage '{name}' (known: {', '.join(self.names)})")
        mode = gcmd.get("MODE", PRIMARY).upper()
        if mode not in MODES:
            raise gcmd.error(f"Invalid mode '{mode}' of a carriage (known: {', '.join(MODES)})")
        group = self.kin.groups[carriage.axis]
        if mode == PRIMARY:
            self.kin.set_modes(group, carriage)
            return
        self._check_follower(gcmd, group, carriage, mode)
        followers = {c: c.mode for c in group.carriages[1:]}
        self.kin.set_modes(group, group.carriages[0], {**followers, carriage: mode})

    @staticmethod
    def _check_follower(gcmd: Any, group: CarriageGroup, carriage: Carriage, mode: str) -> None:
        first = group.carriages[0]
        if carriage is first:
            raise gcmd.error(f"The primary carriage '{first.name}' can not {mode}; the dual one can")
        if first.mode != PRIMARY:
            raise gcmd.error(
                f"Mode {mode} follows the primary carriage, which is not in use: activate '{first.name}' first"
            )
        if not (first.homed and carriage.homed):
            raise gcmd.error(
                f"Must home axis {AXIS_NAMES[group.axis]} first: mode {mode} needs both carriages"
            )

    def cmd_SAVE_DUAL_CARRIAGE_STATE(self, gcmd: Any) -> None:
        """SAVE_DUAL_CARRIAGE_STATE [NAME=]."""
        position = self.kin.toolhead.get_position()
        self.saved[gcmd.get("NAME", "default")] = [
            SavedGroup(
                tuple(c.mode for c in group.carriages),
                tuple(c.place(position[group.axis]) if c.homed else None for c in group.carriages),
            )
            for group in self._groups()
        ]

    def cmd_RESTORE_DUAL_CARRIAGE_STATE(self, gcmd: Any) -> None:
        """RESTORE_DUAL_CARRIAGE_STATE [NAME=] [MOVE=0|1] [MOVE_SPEED=mm/s]."""
        name = gcmd.get("NAME", "default")
        state = self.saved.get(name)
        if state is None:
            raise gcmd.error(f"Unknown DUAL_CARRIAGE state: {name}")
        speed = gcmd.get_float("MOVE_SPEED", None, above=0.0)
        for group, saved in zip(self._groups(), state, strict=True):
            if gcmd.get_int("MOVE", 1):
                self._move_back(group, saved, speed)
            modes = dict(zip(group.carriages, saved.modes, strict=True))
            active = next(c for c, mode in modes.items() if mode == PRIMARY)
            followers = {c: mode for c, mode in modes.items() if mode in (COPY, MIRROR)}
            if followers and not all(c.homed for c in (active, *followers)):
                raise gcmd.error(f"Must home axis {AXIS_NAMES[group.axis]} first")
            self.kin.set_modes(group, active, followers)

    def _move_back(self, group: CarriageGroup, saved: SavedGroup, speed: float | None) -> None:
        """All carriages to their places at once: the one with the longest way leads, the others go their share."""
        position = self.kin.toolhead.get_position()[group.axis]
        ways = {
            c: place - c.place(position)
            for c, place in zip(group.carriages, saved.places, strict=True)
            if place is not None and c.homed
        }
        lead = max(ways, key=lambda c: abs(ways[c]), default=None)
        if lead is None or not ways[lead]:
            return
        target: list[float | None] = [None] * 3
        target[group.axis] = lead.place(position) + ways[lead]
        self.kin.set_modes(
            group, lead, shares={c: way / ways[lead] for c, way in ways.items() if c is not lead}
        )
        self.kin.toolhead.manual_move(target, speed or lead.rail.get_homing_info().speed)


def _rail(config: Any, name: str) -> stepper.GenericPrinterRail:
    return stepper.LookupMultiRail(config.getsection(name))


def _coefficients(machine: LinearMachine) -> list[list[float]]:
    """Motor of rail i = sum of [i][j] * axis j: the inverse of the machine's position()."""
    by_motor = [machine.position(*(1.0 if i == j else 0.0 for i in range(3))) for j in range(3)]
    by_axis = list(zip(*by_motor, strict=True))  # [axis][motor]
    motors = []  # of a unit way along each axis
    for axis in range(3):
        motors.append(solve_axes([(row, float(i == axis)) for i, row in enumerate(by_axis)]) or [0.0] * 3)
    return [list(row) for row in zip(*motors, strict=True)]


def load_dual(toolhead: Any, config: Any, machine: LinearMachine, axes: str) -> CarriageKinematics:
    """A fixed machine with [dual_carriage] on one of `axes`."""
    section = config.getsection(SECTION)
    axis = AXIS_NAMES.index(section.getchoice("axis", {a: a for a in axes}))
    rails = [_rail(config, f"stepper_{name}") for name in AXIS_NAMES]
    dual_rail = _rail(config, SECTION)

    def carriage(name: str, number: int, rail: stepper.GenericPrinterRail) -> Carriage:
        return Carriage(name, number, rail, rail.get_endstops()[0][0])

    primary = [carriage("0" if i == axis else AXIS_NAMES[i], i, rail) for i, rail in enumerate(rails)]
    dual = carriage("1", axis, dual_rail)
    drives = []
    table = _coefficients(machine)
    # the second tool's belt comes from the other side: where the first is driven against an axis, it is driven with it
    dual_row = [factor if i == axis else -factor for i, factor in enumerate(table[axis])]
    with_dual = [dual if c.axis == axis else c for c in primary]
    for rail, row, moved in (
        *((rail, row, primary) for rail, row in zip(rails, table, strict=True)),
        (dual_rail, dual_row, with_dual),
    ):
        mix = {c: row[c.axis] for c in moved if abs(row[c.axis]) > SMALLEST_PIVOT}
        drives += [Drive(motor, mix) for motor in rail.get_steppers()]
    for drive in drives:
        for mover in drive.coefficients:
            for endstop, _name in mover.rail.get_endstops():
                if drive.motor not in mover.rail.get_steppers():
                    endstop.add_stepper(drive.motor)
    safe_mm = {frozenset((primary[axis], dual)): read_safe_distance(section, rails[axis], dual_rail)}
    group = CarriageGroup(axis, (primary[axis], dual), safe_mm)
    described = CarriageMachine((primary[0], primary[1], primary[2]), drives, {axis: group})
    check_machine(config, described)
    kin = CarriageKinematics(toolhead, config, described)
    add_commands(config.get_printer(), kin, {"0": primary[axis], "1": dual})
    return kin


def add_commands(printer: Any, kin: CarriageKinematics, names: dict[str, Carriage]) -> None:
    """Make the printer object and its commands."""
    duals = DualCarriages(printer, kin, names)
    duals.register()
    printer.add_object(SECTION, duals)
