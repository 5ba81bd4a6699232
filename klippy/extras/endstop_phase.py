"""[endstop_phase], [endstop_phase STEPPER]: a motor's phase gives the place of an endstop better than the switch.

A motor goes through `phases` = 4 * microsteps positions and begins again. At the place of the endstop it always stands
in the same phase; the switch is only needed to say which turn it is. The bare section collects the phases of homing
moves (ENDSTOP_PHASE_CALIBRATE); with a stepper's name its homing is corrected.

The phase comes from the driver (a Trinamic one reports it), else from the count of steps, if driver and
micro-controller always start together.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import stepper
from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

DRIVERS = ("tmc2130", "tmc2208", "tmc2209", "tmc2240", "tmc2660", "tmc5160")


def circular_difference(phase: int, reference: int, phases: int) -> int:
    """phase - reference, as the nearest way around: -phases/2 .. phases/2."""
    difference = (phase - reference) % phases
    return difference - phases if difference > phases // 2 else difference


def spread(counts: Counter[int], phases: int) -> tuple[int, int, int]:
    """(best, first, last) of the phases seen: all lie on the arc first..last, and best is nearest to them."""
    seen = sorted(counts)
    gaps = [((seen[(i + 1) % len(seen)] - phase) % phases or phases, i) for i, phase in enumerate(seen)]
    _, before = max(gaps)
    first, last = seen[(before + 1) % len(seen)], seen[before]

    def cost(phase: int) -> int:
        return sum(abs(circular_difference(p, phase, phases)) * n for p, n in counts.items())

    arc = [(first + i) % phases for i in range((last - first) % phases + 1)]
    return min(arc, key=cost), first, last


def find_driver(printer: Printer, stepper_name: str) -> Any:
    """The object of the motor's driver if it can report the phase, else None."""
    for kind in DRIVERS:
        driver = printer.lookup_object(f"{kind} {stepper_name}", None)
        if driver is not None:
            return driver
    return None


@dataclass(slots=True)
class PhaseLog:
    """What homing moves have shown of one motor."""

    phases: int
    counts: Counter[int] = field(default_factory=Counter)
    last: dict[str, int] = field(default_factory=dict)


class PhaseTracker:
    """Printer object 'endstop_phase'."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self._config = config
        self.logs: dict[str, PhaseLog] = {}

    def register(self) -> None:
        self.printer.register_event_handler("homing:home_rails_end", self._handle_home_rails_end)
        self.printer.lookup_object("gcode").register_command(
            "ENDSTOP_PHASE_CALIBRATE", self.cmd_ENDSTOP_PHASE_CALIBRATE, desc="Calibrate stepper phase"
        )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {"last_home": {name: dict(log.last) for name, log in self.logs.items()}}

    def phases_of(self, name: str) -> int:
        section = self._config.getsection(name)
        return 4 * section.getint("microsteps", minval=1, note_valid=False)

    def phase_at(self, name: str, mcu_position: int, phases: int) -> int:
        """Phase of the motor at a position in steps."""
        driver = find_driver(self.printer, name)
        offset = driver.get_phase_offset()[0] if driver is not None else None
        return (mcu_position + (offset or 0)) % phases

    def _handle_home_rails_end(self, homing_state: Any, rails: list[Any]) -> None:
        for rail in rails:
            motor = rail.get_steppers()[0]
            name = motor.get_name()
            log = self.logs.get(name)
            if log is None:
                log = self.logs[name] = PhaseLog(self.phases_of(name))
            position = homing_state.get_trigger_position(name)
            phase = self.phase_at(name, position, log.phases)
            log.counts[phase] += 1
            log.last = {"phase": phase, "phases": log.phases, "mcu_position": position}

    def cmd_ENDSTOP_PHASE_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """ENDSTOP_PHASE_CALIBRATE [STEPPER=<name>]."""
        name = gcmd.get("STEPPER", None)
        if name is None:
            if not self.logs:
                gcmd.respond_info("No steppers have been homed: run G28 first")
            for homed in self.logs:
                gcmd.respond_info(self._describe(homed))
            return
        if name not in self.logs:
            raise gcmd.error(f"Stats not available for stepper {name}: home it first")
        best, _first, _last = spread(self.logs[name].counts, self.logs[name].phases)
        gcmd.respond_info(
            f"{self._describe(name)}\nThe SAVE_CONFIG command will update the printer config file with these "
            "parameters and restart the printer."
        )
        configfile = self.printer.lookup_object("configfile")
        configfile.set(f"endstop_phase {name}", "trigger_phase", f"{best}/{self.logs[name].phases}")

    def _describe(self, name: str) -> str:
        log = self.logs[name]
        best, first, last = spread(log.counts, log.phases)
        return f"{name}: trigger_phase={best}/{log.phases} (range {first} to {last})"


def _trigger_phase(config: ConfigWrapper) -> tuple[int, int] | None:
    """Option trigger_phase: phase/phases."""
    parts = config.getintlist("trigger_phase", None, sep="/", count=2)
    if parts is None:
        return None
    phase, phases = parts
    if phases < 4 or not 0 <= phase < phases:
        raise config.error(
            f"Option 'trigger_phase' in section '{config.get_name()}' is {phase}/{phases}; it is a phase and the "
            "number of phases, such as 7/64"
        )
    return phase, phases


class EndstopPhase:
    """Printer object 'endstop_phase STEPPER': corrects the homing of one motor."""

    def __init__(self, config: ConfigWrapper, tracker: PhaseTracker) -> None:
        self.printer = config.get_printer()
        self.tracker = tracker
        self.name = config.get_name().split(None, 1)[1]
        if not config.has_section(self.name):
            raise config.error(f"Section '{config.get_name()}': there is no stepper '{self.name}'")
        distance, steps = stepper.parse_step_distance(config.getsection(self.name))
        self.step_dist = distance / steps
        self.phases = tracker.phases_of(self.name)
        trigger = _trigger_phase(config)
        self.from_config = trigger is not None
        self.endstop_phase: int | None = None
        if trigger is not None:
            self.endstop_phase = (trigger[0] * self.phases // trigger[1]) % self.phases
        self.align_zero = config.getboolean("endstop_align_zero", False)
        self.accuracy = self._read_accuracy(config)

    def _read_accuracy(self, config: ConfigWrapper) -> int:
        """Phases by which the switch may be off, to either side."""
        accuracy_mm = config.getfloat("endstop_accuracy", None, above=0.0)
        if accuracy_mm is None:
            return self.phases // 2 - 1
        # the phase of a first homing move, taken as reference, may itself be off to the other side
        share = 0.5 if self.from_config else 1.0
        accuracy = math.ceil(accuracy_mm * share / self.step_dist)
        if accuracy >= self.phases // 2:
            raise config.error(
                f"Endstop for {self.name} is not accurate enough for stepper phase adjustment: endstop_accuracy "
                f"{accuracy_mm:g} mm is more than the motor turns between two equal phases"
            )
        return accuracy

    def register(self) -> None:
        self.printer.register_event_handler("homing:home_rails_end", self._handle_home_rails_end)

    def _align_mm(self, position_endstop: float) -> float:
        """Shift of position_endstop that puts zero on a full step of the motor."""
        if not self.align_zero or self.endstop_phase is None:
            return 0.0
        microsteps = self.phases // 4
        full_step = microsteps * self.step_dist
        past_full_step = circular_difference(self.endstop_phase % microsteps, 0, microsteps) * self.step_dist
        return round(position_endstop / full_step) * full_step - position_endstop + past_full_step

    def _correction_mm(self, mcu_position: int) -> float:
        """How far beyond the endstop's real place the motor was when the switch triggered."""
        phase = self.tracker.phase_at(self.name, mcu_position, self.phases)
        if self.endstop_phase is None:  # the first homing move is the reference for those to come
            self.endstop_phase = phase
            return 0.0
        difference = circular_difference(phase, self.endstop_phase, self.phases)
        if abs(difference) > self.accuracy:
            raise self.printer.command_error(
                f"Endstop {self.name} incorrect phase (got {phase} vs {self.endstop_phase})"
            )
        return difference * self.step_dist

    def _handle_home_rails_end(self, homing_state: Any, rails: list[Any]) -> None:
        for rail in rails:
            if rail.get_steppers()[0].get_name() == self.name:
                shift = self._correction_mm(homing_state.get_trigger_position(self.name))
                shift += self._align_mm(rail.get_homing_info().position_endstop)
                homing_state.set_stepper_adjustment(self.name, shift)


def load_config(config: ConfigWrapper) -> PhaseTracker:
    tracker = PhaseTracker(config)
    tracker.register()
    return tracker


def load_config_prefix(config: ConfigWrapper) -> EndstopPhase:
    tracker = config.get_printer().load_object(config, "endstop_phase")
    phase = EndstopPhase(config, tracker)
    phase.register()
    return phase
