"""The paper test: the user moves the nozzle down by TESTZ until paper drags, and says ACCEPT.

MANUAL_PROBE, Z_ENDSTOP_CALIBRATE and Z_OFFSET_APPLY_ENDSTOP; other modules start the same dialogue with
`ManualProbeHelper`. ACCEPT, ABORT and TESTZ exist only while a dialogue is open; so whoever else has an ABORT of its
own (a heater's calibration) keeps it, and only one of them runs at a time.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

DEFAULT_SPEED_MM_S = 5.0
# A height is always approached from above, so that the play of the lead screw is on the same side.
PLAY_MM = 0.5
# Two heights nearer than this are the same.
SAME_MM = 1e-5
# How far TESTZ Z=+ and its kin go at most, and where no height has been tried on that side.
STEP_MM = 0.2
COMMANDS = {
    "ACCEPT": "Accept the current Z position",
    "ABORT": "Abort manual Z probing tool",
    "TESTZ": "Move to new Z height",
}
Finalize = Callable[[Sequence[float] | None], None]  # place of the nozzle (mm), None if the user gave up


def verify_no_manual_probe(printer: Printer) -> None:
    """Raise if a dialogue with the user (this one, or a calibration) is open."""
    if printer.lookup_object("gcode").get_handler("ABORT") is not None:
        raise printer.command_error("Already in a manual Z probe or a calibration. Use ABORT to abort it.")


def kinematic_position(printer: Printer) -> list[float]:
    """x, y, z (mm) at which the motors stand once everything queued is done."""
    toolhead = printer.lookup_object("toolhead")
    toolhead.flush_step_generation()
    kin = toolhead.get_kinematics()
    place = kin.calc_position({s.get_name(): s.get_commanded_position() for s in kin.get_steppers()})
    return [was if new is None else new for new, was in zip(place, toolhead.get_position(), strict=False)]


def report_save_config(gcmd: GCodeCommand, what: str) -> None:
    """The answer of every command that found a value for the config."""
    gcmd.respond_info(
        f"{what}\nThe SAVE_CONFIG command will update the printer config file\n"
        "with the above and restart the printer."
    )


class ProbeResult(NamedTuple):
    """A probed place of the bed, and the nozzle's place at the trigger; mm. Also what plugins give and take."""

    bed_x: float
    bed_y: float
    bed_z: float
    test_x: float
    test_y: float
    test_z: float


class ManualProbeHelper:
    """One dialogue; `finalize_callback` is called at its end."""

    def __init__(self, printer: Printer, gcmd: GCodeCommand, finalize_callback: Finalize) -> None:
        verify_no_manual_probe(printer)
        self.printer = printer
        self.finalize_callback = finalize_callback
        self.speed = gcmd.get_float("SPEED", DEFAULT_SPEED_MM_S, above=0.0)
        self._gcode = printer.lookup_object("gcode")
        self._toolhead = printer.lookup_object("toolhead")
        self._tested: list[float] = []  # heights, sorted
        self._z_mm = kinematic_position(printer)[2]
        self._status = printer.lookup_object("manual_probe")
        for name, text in COMMANDS.items():
            self._gcode.register_command(name, getattr(self, f"cmd_{name}"), desc=text)
        self._gcode.respond_info(
            "Starting manual Z probe. Use TESTZ to adjust position.\nFinish with ACCEPT or ABORT command."
        )
        self._report()

    def _neighbours(self) -> tuple[float | None, float | None]:
        """Tested heights next below and above the present one."""
        below = bisect.bisect_left(self._tested, self._z_mm - SAME_MM)
        above = bisect.bisect_right(self._tested, self._z_mm + SAME_MM)
        lower = self._tested[below - 1] if below else None
        return lower, self._tested[above] if above < len(self._tested) else None

    def _report(self) -> None:
        self._z_mm = kinematic_position(self.printer)[2]
        lower, upper = self._neighbours()
        self._status.note(self._z_mm, lower, upper)
        left, right = ("??????" if z is None else f"{z:.3f}" for z in (lower, upper))
        self._gcode.respond_info(f"Z position: {left} --> {self._z_mm:.3f} <-- {right}")

    def _go_to(self, z_mm: float) -> None:
        """Move to a height; to one that is not that far below by way of a place above it."""
        if z_mm + PLAY_MM > self._z_mm:
            self._toolhead.manual_move([None, None, z_mm + PLAY_MM], self.speed)
        self._toolhead.manual_move([None, None, z_mm], self.speed)

    def _wanted(self, gcmd: GCodeCommand) -> float:
        """The height that TESTZ asks for."""
        text = gcmd.get("Z")
        if text not in ("+", "++", "-", "--"):
            return self._z_mm + gcmd.get_float("Z")
        lower, upper = self._neighbours()
        tried = upper if text[0] == "+" else lower
        way = STEP_MM if tried is None else min(STEP_MM, abs(tried - self._z_mm) / (3 - len(text)))
        return self._z_mm + math.copysign(way, 1.0 if text[0] == "+" else -1.0)

    def cmd_TESTZ(self, gcmd: GCodeCommand) -> None:
        """TESTZ Z=<mm>|+|++|-|--: by a distance, half way to a height tried before, or back to it; 0.2 mm at most."""
        wanted = self._wanted(gcmd)
        self._go_to(wanted)
        place = bisect.bisect_left(self._tested, self._z_mm)
        if not any(abs(z - self._z_mm) < SAME_MM for z in self._tested[max(0, place - 1) : place + 1]):
            self._tested.insert(place, self._z_mm)
        self._report()

    def cmd_ACCEPT(self, gcmd: GCodeCommand) -> None:
        """This is the height."""
        self._finish(kinematic_position(self.printer))

    def cmd_ABORT(self, gcmd: GCodeCommand) -> None:
        """End without a result."""
        self._gcode.respond_info("Manual probe aborted")
        self._finish(None)

    def _finish(self, place: Sequence[float] | None) -> None:
        for name in COMMANDS:
            self._gcode.register_command(name, None)
        self._status.note(None, None, None)
        self.finalize_callback(place)


class ManualProbe:
    """Printer object 'manual_probe': the commands, and the status of whatever dialogue is open."""

    def __init__(self, printer: Printer, endstop: tuple[str, float] | None) -> None:
        self.printer = printer
        self._endstop = endstop  # section with the Z endstop's position_endstop, and that (mm)
        self._status: dict[str, Any] = {}
        self.note(None, None, None)

    def register(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command("MANUAL_PROBE", self.cmd_MANUAL_PROBE, desc="Start manual probe helper script")
        if self._endstop is not None:
            for name, text in (
                ("Z_ENDSTOP_CALIBRATE", "Calibrate a Z endstop"),
                ("Z_OFFSET_APPLY_ENDSTOP", "Adjust the z endstop_position"),
            ):
                gcode.register_command(name, getattr(self, f"cmd_{name}"), desc=text)

    def note(self, z_mm: float | None, lower: float | None, upper: float | None) -> None:
        """Where the open dialogue is; z None: there is none."""
        self._status = {
            "is_active": z_mm is not None,
            "z_position": z_mm,
            "z_position_lower": lower,
            "z_position_upper": upper,
        }

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return self._status

    def cmd_MANUAL_PROBE(self, gcmd: GCodeCommand) -> None:
        """MANUAL_PROBE [SPEED=mm/s]."""

        def finalize(place: Sequence[float] | None) -> None:
            if place is not None:
                gcmd.respond_info(f"Z position is {place[2]:.3f}")

        ManualProbeHelper(self.printer, gcmd, finalize)

    def _propose(self, gcmd: GCodeCommand, position_mm: float) -> None:
        assert self._endstop is not None
        section = self._endstop[0]
        report_save_config(gcmd, f"{section}: position_endstop: {position_mm:.3f}")
        self.printer.lookup_object("configfile").set(section, "position_endstop", f"{position_mm:.3f}")

    def cmd_Z_ENDSTOP_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """Z_ENDSTOP_CALIBRATE [SPEED=mm/s]: the height found by hand becomes z = 0."""
        assert self._endstop is not None
        configured_mm = self._endstop[1]

        def finalize(place: Sequence[float] | None) -> None:
            if place is not None:
                self._propose(gcmd, configured_mm - place[2])

        ManualProbeHelper(self.printer, gcmd, finalize)

    def cmd_Z_OFFSET_APPLY_ENDSTOP(self, gcmd: GCodeCommand) -> None:
        """Take SET_GCODE_OFFSET Z=… over into position_endstop."""
        offset_mm = self.printer.lookup_object("gcode_move").get_status()["homing_origin"].z
        if not offset_mm:
            gcmd.respond_info("Nothing to do: Z Offset is 0")
            return
        assert self._endstop is not None
        self._propose(gcmd, self._endstop[1] - offset_mm)


def _find_endstop(config: ConfigWrapper) -> tuple[str, float] | None:
    """The section that holds the Z endstop's place, and the place."""
    for name in ("stepper_z", "carriage z"):
        if config.has_section(name):
            section = config.getsection(name)
            place = section.getfloat("position_endstop", None, note_valid=False)
            if place is not None:
                return name, place
    return None


def load_config(config: ConfigWrapper) -> ManualProbe:
    """Loaded with every printer."""
    probe = ManualProbe(config.get_printer(), _find_endstop(config))
    probe.register()
    return probe
