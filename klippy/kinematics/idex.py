"""[dual_carriage]: a second carriage on an axis. SET_DUAL_CARRIAGE, SAVE_ and RESTORE_DUAL_CARRIAGE_STATE.

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
    INACTIVE,
    MIRROR,
    PRIMARY,
    SMALLEST_PIVOT,
    Carriage,
    CarriageKinematics,
    CarriageMachine,
    CarriagePair,
    Drive,
    check_machine,
    read_safe_distance,
    solve_axes,
)

SECTION = "dual_carriage"
MODES = (PRIMARY, COPY, MIRROR)


@dataclass(frozen=True, slots=True)
class SavedPair:
    """Modes of a pair's two carriages and their places (mm; None: not homed)."""

    modes: tuple[str, str]
    places: tuple[float | None, float | None]


class DualCarriages:
    """The commands, and the status of all pairs."""

    def __init__(self, printer: Any, kin: CarriageKinematics, names: dict[str, Carriage]) -> None:
        self.printer = printer
        self.kin = kin
        self.names = names  # as CARRIAGE= names them
        self.saved: dict[str, list[SavedPair]] = {}

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

    def _pairs(self) -> list[CarriagePair]:
        return list(self.kin.pairs.values())

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
        pair = self.kin.pairs[carriage.axis]
        if mode == PRIMARY:
            self.kin.set_modes(pair, carriage, INACTIVE)
            return
        self._check_follower(gcmd, pair, carriage, mode)
        self.kin.set_modes(pair, pair.carriages[0], mode)

    @staticmethod
    def _check_follower(gcmd: Any, pair: CarriagePair, carriage: Carriage, mode: str) -> None:
        first = pair.carriages[0]
        if carriage is first:
            raise gcmd.error(f"The primary carriage '{first.name}' can not {mode}; the dual one can")
        if first.mode != PRIMARY:
            raise gcmd.error(
                f"Mode {mode} follows the primary carriage, which is not in use: activate '{first.name}' first"
            )
        if not (first.homed and carriage.homed):
            raise gcmd.error(
                f"Must home axis {AXIS_NAMES[pair.axis]} first: mode {mode} needs both carriages"
            )

    def cmd_SAVE_DUAL_CARRIAGE_STATE(self, gcmd: Any) -> None:
        """SAVE_DUAL_CARRIAGE_STATE [NAME=]."""
        position = self.kin.toolhead.get_position()
        state = []
        for pair in self._pairs():
            first, second = pair.carriages
            places = [c.place(position[pair.axis]) if c.homed else None for c in pair.carriages]
            state.append(SavedPair((first.mode, second.mode), (places[0], places[1])))
        self.saved[gcmd.get("NAME", "default")] = state

    def cmd_RESTORE_DUAL_CARRIAGE_STATE(self, gcmd: Any) -> None:
        """RESTORE_DUAL_CARRIAGE_STATE [NAME=] [MOVE=0|1] [MOVE_SPEED=mm/s]."""
        name = gcmd.get("NAME", "default")
        state = self.saved.get(name)
        if state is None:
            raise gcmd.error(f"Unknown DUAL_CARRIAGE state: {name}")
        speed = gcmd.get_float("MOVE_SPEED", None, above=0.0)
        for pair, saved in zip(self._pairs(), state, strict=True):
            if gcmd.get_int("MOVE", 1):
                self._move_back(pair, saved, speed)
            first, second = pair.carriages
            if saved.modes[0] == PRIMARY:
                if saved.modes[1] != INACTIVE and not (first.homed and second.homed):
                    raise gcmd.error(f"Must home axis {AXIS_NAMES[pair.axis]} first")
                self.kin.set_modes(pair, first, saved.modes[1])
            else:
                self.kin.set_modes(pair, second, INACTIVE)

    def _move_back(self, pair: CarriagePair, saved: SavedPair, speed: float | None) -> None:
        """Each carriage to its place; first the one whose way is clear of the other."""
        way = [
            (c, place)
            for c, place in zip(pair.carriages, saved.places, strict=True)
            if place is not None and c.homed
        ]
        if len(way) == 2 and not self._is_clear(pair, *way[0]):
            way.reverse()
        for carriage, place in way:
            self.kin.set_modes(pair, carriage, INACTIVE)
            target: list[float | None] = [None] * 3
            target[pair.axis] = place
            self.kin.toolhead.manual_move(target, speed or carriage.rail.get_homing_info().speed)

    def _is_clear(self, pair: CarriagePair, carriage: Carriage, place: float) -> bool:
        self.kin.set_modes(pair, carriage, INACTIVE)
        low, high = pair.limits()
        return low <= place <= high


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
    pair = CarriagePair(axis, (primary[axis], dual), read_safe_distance(section, rails[axis], dual_rail))
    described = CarriageMachine((primary[0], primary[1], primary[2]), drives, {axis: pair})
    check_machine(config, described)
    kin = CarriageKinematics(toolhead, config, described)
    add_commands(config.get_printer(), kin, {"0": primary[axis], "1": dual})
    return kin


def add_commands(printer: Any, kin: CarriageKinematics, names: dict[str, Carriage]) -> None:
    """Make the printer object and its commands."""
    duals = DualCarriages(printer, kin, names)
    duals.register()
    printer.add_object(SECTION, duals)
