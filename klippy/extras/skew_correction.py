"""[skew_correction]: straightens a machine whose axes are not square to each other.

The machine makes of a commanded point (x, y, z) the point

    X = x + a*y + b*z        Y = y + c*z        Z = z

with a, b, c the skew of the planes xy, xz, yz (tangent of the angle missing to 90 degrees). What is commanded is the
inverse: y = Y - c*Z, x = X - a*y - b*Z.

A plane's skew is measured on a printed parallelogram ABCD by both diagonals and the side AD.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import chelper
from configfile import ConfigWrapper
from gcode import GCodeCommand
from lookahead import done_in_c
from roles import Printer

PLANES = ("xy", "xz", "yz")


@dataclass(frozen=True, slots=True)
class Skew:
    """Tangents of the missing angles."""

    xy: float = 0.0
    xz: float = 0.0
    yz: float = 0.0

    def commanded(self, wanted: Sequence[float]) -> list[float]:
        """What to command to reach a point; further coordinates stay."""
        ffi, lib = chelper.get_ffi()
        place = ffi.new("double[4]")
        lib.path_unskew(self.stage(), wanted[:4], place)
        return [*place[0:3], *wanted[3:]]

    def stage(self) -> Any:
        """The same in the C helper (path_stage.h)."""
        ffi, lib = chelper.get_ffi()
        return ffi.new(
            "struct path_stage *",
            {"kind": lib.PATH_SKEW, "skew_xy": self.xy, "skew_xz": self.xz, "skew_yz": self.yz},
        )

    def reached(self, commanded: Sequence[float]) -> list[float]:
        """The point the machine goes to."""
        x, y, z = commanded[:3]
        return [x + self.xy * y + self.xz * z, y + self.yz * z, z, *commanded[3:]]


def measured_skew(ac: float, bd: float, ad: float) -> float:
    """Skew from the lengths (mm) of the diagonals AC, BD and the side AD; ValueError if there is no such part."""
    side2 = 0.5 * (ac * ac + bd * bd) - ad * ad  # AC^2 + BD^2 = 2 AB^2 + 2 AD^2
    if side2 <= 0.0 or ad <= 0.0:
        raise ValueError("there is no parallelogram with these lengths")
    # AC^2 = AB^2 + AD^2 + 2 AB AD cos(A), and BD^2 the same with a minus: the difference gives the angle at A
    cosine = (ac * ac - bd * bd) / (4.0 * math.sqrt(side2) * ad)
    if not -1.0 < cosine < 1.0:
        raise ValueError("there is no parallelogram with these lengths")
    return cosine / math.sqrt(1.0 - cosine * cosine)


class SkewCorrection:
    """Printer object 'skew_correction'; a transform between G-code and toolhead."""

    def __init__(self, printer: Printer, profiles: dict[str, Skew]) -> None:
        self.printer = printer
        self.name = "skew_correction"
        self.skew = Skew()
        self.profiles = profiles
        self.current_profile = ""
        self.next_transform: Any = None

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._handle_connect)
        gcode = self.printer.lookup_object("gcode")
        for name, text in (
            ("SET_SKEW", "Set skew based on lengths of measured object"),
            ("GET_CURRENT_SKEW", "Report current printer skew"),
            ("CALC_MEASURED_SKEW", "Calculate skew from measured print"),
            ("SKEW_PROFILE", "Profile management for skew_correction"),
        ):
            gcode.register_command(name, getattr(self, f"cmd_{name}"), desc=text)

    def _handle_connect(self) -> None:
        gcode_move = self.printer.lookup_object("gcode_move")
        self.next_transform = gcode_move.set_move_transform(self, force=True)
        if self.next_transform is None:
            self.next_transform = self.printer.lookup_object("toolhead")

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {"current_profile_name": self.current_profile}

    # -- the transform --

    def get_position(self) -> list[float]:
        return self.skew.reached(self.next_transform.get_position())

    def row_stage(self) -> Any:
        """This transform for a row of moves."""
        return self.skew.stage()

    def take_row(self, stage: Any) -> None:
        """Such a row has been run: nothing is remembered of it."""

    @done_in_c
    def move(self, newpos: Sequence[float], speed: float) -> None:
        self.next_transform.move(self.skew.commanded(newpos), speed)

    def _use(self, skew: Skew, profile: str = "") -> None:
        self.skew, self.current_profile = skew, profile
        self.printer.lookup_object("gcode_move").reset_last_position()

    # -- commands --

    @staticmethod
    def _lengths(gcmd: GCodeCommand, plane: str) -> float:
        """Skew from a parameter XY=ac,bd,ad."""
        text = gcmd.get(plane.upper())
        try:
            ac, bd, ad = (float(part) for part in text.split(","))
            if not (math.isfinite(ac + bd + ad) and min(ac, bd, ad) > 0.0):
                raise ValueError("lengths must be positive numbers")
            return measured_skew(ac, bd, ad)
        except ValueError as e:
            raise gcmd.error(
                f"{gcmd.get_command()}: {plane.upper()}={text}: expected the lengths AC,BD,AD in mm ({e})"
            ) from None

    def cmd_SET_SKEW(self, gcmd: GCodeCommand) -> None:
        """SET_SKEW [XY=ac,bd,ad] [XZ=ac,bd,ad] [YZ=ac,bd,ad] [CLEAR=0|1]."""
        if gcmd.get_int("CLEAR", 0):
            self._use(Skew())
            return
        factors = {
            plane: getattr(self.skew, plane)
            if gcmd.get(plane.upper(), None) is None
            else self._lengths(gcmd, plane)
            for plane in PLANES
        }
        self._use(Skew(**factors))

    def cmd_GET_CURRENT_SKEW(self, gcmd: GCodeCommand) -> None:
        """GET_CURRENT_SKEW."""
        lines = ["Current Printer Skew:"]
        for plane in PLANES:
            angle = math.atan(getattr(self.skew, plane))
            lines.append(f"{plane.upper()} Skew: {angle:.6f} radians, {math.degrees(angle):.2f} degrees")
        gcmd.respond_info("\n".join(lines))

    def cmd_CALC_MEASURED_SKEW(self, gcmd: GCodeCommand) -> None:
        """CALC_MEASURED_SKEW AC= BD= AD=."""
        ac, bd, ad = (gcmd.get_float(name, above=0.0) for name in ("AC", "BD", "AD"))
        try:
            angle = math.atan(measured_skew(ac, bd, ad))
        except ValueError as e:
            raise gcmd.error(f"CALC_MEASURED_SKEW: {e}") from None
        gcmd.respond_info(f"Calculated Skew: {angle:.6f} radians, {math.degrees(angle):.2f} degrees")

    def cmd_SKEW_PROFILE(self, gcmd: GCodeCommand) -> None:
        """SKEW_PROFILE LOAD=<name>|SAVE=<name>|REMOVE=<name>."""
        for action in ("LOAD", "SAVE", "REMOVE"):
            name = gcmd.get(action, None)
            if name is not None:
                break
        else:
            raise gcmd.error("SKEW_PROFILE needs LOAD=, SAVE= or REMOVE=")
        if not name.strip():
            raise gcmd.error(f"SKEW_PROFILE: {action} needs the name of a profile")
        if action == "SAVE":
            self._save(gcmd, name)
        elif name not in self.profiles:
            raise gcmd.error(f"skew_correction: no profile named [{name}]")
        elif action == "LOAD":
            self._use(self.profiles[name], name)
        else:
            del self.profiles[name]
            self.printer.lookup_object("configfile").remove_section(f"{self.name} {name}")
            gcmd.respond_info(
                f"Profile [{name}] removed from storage for this session.\n"
                "The SAVE_CONFIG command will update the printer configuration and restart the printer"
            )

    def _save(self, gcmd: GCodeCommand, name: str) -> None:
        configfile = self.printer.lookup_object("configfile")
        for part in fields(self.skew):
            configfile.set(f"{self.name} {name}", f"{part.name}_skew", getattr(self.skew, part.name))
        self.profiles[name] = self.skew
        gcmd.respond_info(
            f"Skew Correction state has been saved to profile [{name}] for the current session.\n"
            "The SAVE_CONFIG command will update the printer config file and restart the printer."
        )


def load_config(config: ConfigWrapper) -> SkewCorrection:
    printer = config.get_printer()
    printer.load_object(config, "gcode_move")
    profiles = {
        section.get_name().split(None, 1)[1]: Skew(
            *(section.getfloat(f"{plane}_skew", 0.0) for plane in PLANES)
        )
        for section in config.get_prefix_sections("skew_correction ")
    }
    correction = SkewCorrection(printer, profiles)
    correction.register()
    return correction
