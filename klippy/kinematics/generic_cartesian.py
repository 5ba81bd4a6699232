"""kinematics: generic_cartesian — carriages along x, y and z, and motors that each move any mix of them.

[carriage NAME]        one for each axis: range and endstop
[extra_carriage NAME]  another endstop for a carriage of the same axis, with motors of its own
[dual_carriage NAME]   a further, independent carriage on an axis (see idex.py)
[stepper NAME]         carriages: carriage_x-0.5*carriage_y
"""

from __future__ import annotations

import re
from typing import Any

import stepper
from kinematics import idex
from kinematics.axes import AXIS_NAMES
from kinematics.carriages import (
    Carriage,
    CarriageGroup,
    CarriageKinematics,
    CarriageMachine,
    CarriageRail,
    Drive,
    check_machine,
    describe,
    range_shift,
    read_safe_distance,
)

# sign, factor with or without *, name of a carriage
_TERM = re.compile(r"\s*(?P<sign>[+-]?)\s*(?:(?P<factor>\d+\.?\d*|\.\d+)\s*\*?\s*)?(?P<name>[A-Za-z_]\w*)\s*")


def parse_mix(text: str, carriages: dict[str, Carriage]) -> dict[Carriage, float]:
    """'carriage_x-0.5*carriage_y' as coefficients; raises ValueError with a text for the user."""
    mix: dict[Carriage, float] = {}
    at = 0
    while at < len(text):
        term = _TERM.match(text, at)
        if term is None or (mix and not term["sign"]):
            raise ValueError(f"'{text}' is not a sum of carriages, such as carriage_x-0.5*carriage_y")
        carriage = carriages.get(term["name"])
        if carriage is None:
            raise ValueError(
                f"'{text}' names an unknown carriage '{term['name']}' (known: {', '.join(carriages)})"
            )
        if carriage in mix:
            raise ValueError(f"'{text}' names carriage '{carriage.name}' twice")
        factor = float(term["factor"] or 1.0) * (-1.0 if term["sign"] == "-" else 1.0)
        if not factor:
            raise ValueError(f"'{text}' gives carriage '{carriage.name}' the factor 0")
        mix[carriage] = factor
        at = term.end()
    if not mix:
        raise ValueError("no carriage is named")
    return mix


class _Reader:
    """Builds the machine from the sections of the configuration."""

    def __init__(self, config: Any) -> None:
        self.config = config
        self.carriages: dict[str, Carriage] = {}
        self.primary: dict[int, Carriage] = {}
        self.groups: dict[int, CarriageGroup] = {}

    def _add(self, section: Any, carriage: Carriage) -> Carriage:
        if carriage.name in self.carriages:
            raise section.error(
                f"Carriage '{carriage.name}' is defined twice (section '{section.get_name()}')"
            )
        self.carriages[carriage.name] = carriage
        return carriage

    @staticmethod
    def _name(section: Any) -> str:
        name = section.get_name().split(None, 1)[-1]
        if not re.fullmatch(r"[A-Za-z_]\w*", name):
            raise section.error(
                f"Section '{section.get_name()}': the name of a carriage is made of letters, digits and '_'"
            )
        return name

    def _primary_of(self, section: Any) -> Carriage:
        name = section.get("primary_carriage")
        carriage = self.carriages.get(name)
        if carriage is None or carriage.follows is not None:
            raise section.error(
                f"Option 'primary_carriage' in section '{section.get_name()}': there is no carriage '{name}'"
            )
        return carriage

    def read_primary(self) -> None:
        for section in self.config.get_prefix_sections("carriage "):
            name = self._name(section)
            choices = {a: a for a in AXIS_NAMES}
            axis = AXIS_NAMES.index(section.getchoice("axis", choices, *([name] if name in choices else [])))
            if axis in self.primary:
                raise section.error(
                    f"Section '{section.get_name()}': axis {AXIS_NAMES[axis]} already has the carriage "
                    f"'{self.primary[axis].name}'; use [extra_carriage] or [dual_carriage] for more"
                )
            rail = CarriageRail(section)
            self.primary[axis] = self._add(section, Carriage(name, axis, rail, rail.get_endstops()[0][0]))
        for axis, letter in enumerate(AXIS_NAMES):
            if axis not in self.primary:
                raise self.config.error(
                    f"generic_cartesian needs a carriage for axis {letter}: add a section [carriage {letter}]"
                )

    def read_dual(self) -> None:
        if self.config.has_section(idex.SECTION):
            raise self.config.error(
                "With generic_cartesian a second carriage has a name: [dual_carriage NAME] with primary_carriage"
            )
        for section in self.config.get_prefix_sections(f"{idex.SECTION} "):
            axis = section.getchoice("axis", AXIS_NAMES, None)
            if axis is None or section.get("primary_carriage", None) is not None:
                primary = self._primary_of(section)
            else:
                primary = self.primary[AXIS_NAMES.index(axis)]
            if axis not in (None, AXIS_NAMES[primary.axis]):
                raise section.error(
                    f"Option 'axis' in section '{section.get_name()}': primary_carriage '{primary.name}' is on axis"
                    f" {AXIS_NAMES[primary.axis]} ({section.where('axis')})."
                )
            rail = CarriageRail(section)
            dual = Carriage(self._name(section), primary.axis, rail, rail.get_endstops()[0][0])
            self._add(section, dual)
            self._add_dual(section, primary, dual)

    def _add_dual(self, section: Any, primary: Carriage, dual: Carriage) -> None:
        """Option safe_distance is to the primary carriage; to the others of the axis, what their ranges say."""
        group = self.groups.setdefault(
            primary.axis, CarriageGroup(primary.axis, (self.primary[primary.axis],), {})
        )
        for other in group.carriages:
            shift_mm = range_shift(other.rail, dual.rail)
            if other is primary:
                shift_mm = read_safe_distance(section, primary.rail, dual.rail)
            group.safe_mm[frozenset((other, dual))] = shift_mm
        group.carriages = (*group.carriages, dual)

    def read_extra(self) -> None:
        for section in self.config.get_prefix_sections("extra_carriage "):
            main, name = self._primary_of(section), self._name(section)
            rail = main.rail
            assert isinstance(rail, CarriageRail)
            endstop = rail.add_endstop(section.get("endstop_pin"), name, section)
            self._add(section, Carriage(name, main.axis, rail, endstop, follows=main))

    def read_drives(self) -> list[Drive]:
        drives = []
        for section in self.config.get_prefix_sections("stepper "):
            try:
                mix = parse_mix(section.get("carriages"), self.carriages)
            except ValueError as e:
                raise section.error(f"Option 'carriages' in section '{section.get_name()}': {e}") from None
            motor = stepper.PrinterStepper(section)
            for carriage in mix:
                assert isinstance(carriage.rail, CarriageRail)
                carriage.rail.attach(motor, carriage.endstop)
            drives.append(Drive(motor, mix))
        moved = {c for drive in drives for c in drive.coefficients}
        for carriage in self.carriages.values():
            if carriage not in moved:
                raise self.config.error(
                    f"Carriage '{carriage.name}' is moved by no stepper: name it in 'carriages' of a [stepper NAME]"
                )
        return drives

    def read(self) -> CarriageMachine:
        self.read_primary()
        self.read_dual()
        self.read_extra()
        drives = self.read_drives()
        return CarriageMachine((self.primary[0], self.primary[1], self.primary[2]), drives, self.groups)


class GenericCartesianKinematics(CarriageKinematics):
    """With the command to change what the motors move."""

    def __init__(self, toolhead: Any, config: Any, reader: _Reader, machine: CarriageMachine) -> None:
        super().__init__(toolhead, config, machine)
        self._carriages = reader.carriages
        printer = config.get_printer()
        printer.lookup_object("gcode").register_command(
            "SET_STEPPER_CARRIAGES", self.cmd_SET_STEPPER_CARRIAGES, desc="Set stepper carriages"
        )
        if machine.groups:
            names = {c.name: c for group in machine.groups.values() for c in group.carriages}
            idex.add_commands(printer, self, names)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        status = super().get_status(eventtime)
        status["steppers"] = {
            drive.motor.get_name(): {"carriages": describe(drive.coefficients)}
            for drive in self.machine.drives
        }
        return status

    def cmd_SET_STEPPER_CARRIAGES(self, gcmd: Any) -> None:
        """SET_STEPPER_CARRIAGES STEPPER=<name> CARRIAGES=<mix> [DISABLE_CHECKS=0|1]: other factors, same carriages."""
        name = gcmd.get("STEPPER")
        drive = next((d for d in self.machine.drives if name in self._names_of(d)), None)
        if drive is None:
            known = ", ".join(d.motor.get_name() for d in self.machine.drives)
            raise gcmd.error(f"Unknown stepper '{name}' (known: {known})")
        try:
            mix = parse_mix(gcmd.get("CARRIAGES"), self._carriages)
        except ValueError as e:
            raise gcmd.error(f"CARRIAGES: {e}") from None
        if set(mix) != set(drive.coefficients):
            raise gcmd.error(
                f"Stepper '{name}' moves {describe(drive.coefficients)}: carriages can not be added or removed, "
                "only their factors can change"
            )
        check = not gcmd.get_int("DISABLE_CHECKS", 0, minval=0, maxval=1)
        self.toolhead.flush_step_generation()
        old, drive.coefficients = drive.coefficients, mix
        if check:
            try:
                check_machine(_AsConfig(gcmd), self.machine)
            except self.printer.command_error:
                drive.coefficients = old
                raise
        self._set_mixes()
        self.toolhead.set_position(self.toolhead.get_position())
        self.printer.send_event("dual_carriage:update_kinematics")

    @staticmethod
    def _names_of(drive: Drive) -> tuple[str, str]:
        """'stepper a' may be called just 'a'."""
        name = drive.motor.get_name()
        return name, name.removeprefix("stepper ")


class _AsConfig:
    """Lets check_machine raise the errors of a command."""

    def __init__(self, gcmd: Any) -> None:
        self.error = gcmd.error


def load_kinematics(toolhead: Any, config: Any) -> GenericCartesianKinematics:
    reader = _Reader(config)
    machine = reader.read()
    check_machine(config, machine)
    return GenericCartesianKinematics(toolhead, config, reader, machine)
