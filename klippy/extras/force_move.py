"""Diagnostics on single steppers: STEPPER_BUZZ; with enable_force_move also FORCE_MOVE and SET_KINEMATIC_POSITION."""

from __future__ import annotations

import math
from typing import Any

import chelper
import stepstream
from configfile import ConfigWrapper
from gcode import GCodeCommand
from motionlimits import ACCEL, POSITION, SPEED, check_way, or_zero
from roles import Printer

BUZZ_DISTANCE_MM = 1.0
BUZZ_SPEED_MM_S = 4.0
BUZZ_DISTANCE_RAD = math.radians(1.0)
BUZZ_SPEED_RAD_S = 4.0 * BUZZ_DISTANCE_RAD
BUZZ_COUNT = 10
BUZZ_PAUSE_S = (0.050, 0.450)  # between forth and back, and before the next


def trapezoid(distance: float, speed: float, accel: float) -> tuple[float, float, float]:
    """(time to accelerate, time to cruise, top speed) of a move from rest to rest; accel 0: no ramps."""
    if not accel:
        return 0.0, distance / speed, speed
    top = min(speed, math.sqrt(distance * accel))
    accel_t = top / accel
    return accel_t, (distance - accel_t * top) / top, top


def calc_move_time(dist: float, speed: float, accel: float) -> tuple[float, float, float, float]:
    """(direction, time to accelerate, time to cruise, top speed), as plugins ask for it."""
    return (math.copysign(1.0, dist), *trapezoid(abs(dist), speed, accel))


class ForceMove:
    """Printer object 'force_move'."""

    def __init__(self, printer: Printer, is_enabled: bool) -> None:
        self.printer = printer
        self.is_enabled = is_enabled
        self.steppers: dict[str, Any] = {}
        _ffi, self._lib = chelper.get_ffi()
        self._streams = stepstream.lookup_streams(printer)
        self._trapq = self._streams.new_trapq()

    def register_commands(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command(
            "STEPPER_BUZZ", self.cmd_STEPPER_BUZZ, desc="Oscillate a given stepper to help id it"
        )
        if self.is_enabled:
            gcode.register_command(
                "FORCE_MOVE", self.cmd_FORCE_MOVE, desc="Manually move a stepper; invalidates kinematics"
            )
            gcode.register_command(
                "SET_KINEMATIC_POSITION", self.cmd_SET_KINEMATIC_POSITION,
                desc="Force a low-level kinematic position",
            )  # fmt: skip

    def register_stepper(self, config: ConfigWrapper, mcu_stepper: Any) -> None:
        self.steppers[mcu_stepper.get_name()] = mcu_stepper

    def lookup_stepper(self, name: str) -> Any:
        if name not in self.steppers:
            raise self.printer.config_error(f"Unknown stepper {name}")
        return self.steppers[name]

    def manual_move(self, stepper: Any, dist: float, speed: float, accel: float = 0.0) -> None:
        """Turn one stepper by dist mm; the kinematics does not know of it."""
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.flush_step_generation()
        solver = self._lib.cartesian_stepper_alloc(b"x")
        old_solver = stepper.set_stepper_kinematics(solver)
        old_trapq = stepper.set_trapq(self._trapq)
        try:
            stepper.set_position((0.0, 0.0, 0.0))
            accel_t, cruise_t, top = trapezoid(abs(dist), speed, accel)
            print_time = toolhead.get_last_move_time()
            self._lib.trapq_append(
                self._trapq, print_time, accel_t, cruise_t, accel_t,
                0.0, 0.0, 0.0, math.copysign(1.0, dist), 0.0, 0.0, 0.0 if accel else top, top, accel,
            )  # fmt: skip
            toolhead.dwell(accel_t + cruise_t + accel_t)
            toolhead.flush_step_generation()
        finally:
            stepper.set_trapq(old_trapq)
            stepper.set_stepper_kinematics(old_solver)
            self._lib.itersolve_free(solver)

    def _stepper_of(self, gcmd: GCodeCommand) -> Any:
        name = gcmd.get("STEPPER")
        if name not in self.steppers:
            raise gcmd.error(f"Unknown stepper {name} (known: {', '.join(self.steppers)})")
        return self.steppers[name]

    def _force_enable(self, stepper: Any) -> bool:
        """Switch the motor on; True if it was off."""
        enable = self.printer.lookup_object("stepper_enable")
        return enable.set_motors_enable([stepper.get_name()], True, at_once=True)

    def cmd_STEPPER_BUZZ(self, gcmd: GCodeCommand) -> None:
        """STEPPER_BUZZ STEPPER=<name>: ten times forth and back by 1 mm."""
        stepper = self._stepper_of(gcmd)
        was_off = self._force_enable(stepper)
        dist, speed = BUZZ_DISTANCE_MM, BUZZ_SPEED_MM_S
        if stepper.units_in_radians():
            dist, speed = BUZZ_DISTANCE_RAD, BUZZ_SPEED_RAD_S
        toolhead = self.printer.lookup_object("toolhead")
        for _ in range(BUZZ_COUNT):
            self.manual_move(stepper, dist, speed)
            toolhead.dwell(BUZZ_PAUSE_S[0])
            self.manual_move(stepper, -dist, speed)
            toolhead.dwell(BUZZ_PAUSE_S[1])
        if was_off:
            self.printer.lookup_object("stepper_enable").set_motors_enable([stepper.get_name()], False)

    def cmd_FORCE_MOVE(self, gcmd: GCodeCommand) -> None:
        """FORCE_MOVE STEPPER= DISTANCE=mm VELOCITY=mm/s [ACCEL=mm/s^2]."""
        stepper = self._stepper_of(gcmd)
        distance = gcmd.get_float("DISTANCE", **POSITION)
        speed = gcmd.get_float("VELOCITY", **SPEED)
        accel = or_zero(gcmd.get_float, "ACCEL", 0.0, ACCEL)
        if not distance:
            return
        check_way(stepper.get_name(), distance, stepper.get_step_dist())
        self._force_enable(stepper)
        self.manual_move(stepper, distance, speed, accel)

    def cmd_SET_KINEMATIC_POSITION(self, gcmd: GCodeCommand) -> None:
        """SET_KINEMATIC_POSITION [X=] [Y=] [Z=] [SET_HOMED=xyz] [CLEAR_HOMED=xyz]."""
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.get_last_move_time()
        current = toolhead.get_position()
        place = [gcmd.get_float(axis, current[i], **POSITION) for i, axis in enumerate("XYZ")]
        homed = gcmd.get("SET_HOMED", "xyz").lower()
        cleared = gcmd.get("CLEAR_HOMED", "").lower()
        if set(homed + cleared) - set("xyz"):
            raise gcmd.error("SET_HOMED and CLEAR_HOMED name axes: x, y, z")
        toolhead.set_position([*place, current[3]], homing_axes=homed)
        toolhead.get_kinematics().clear_homing_state(cleared)


def load_config(config: ConfigWrapper) -> ForceMove:
    force_move = ForceMove(config.get_printer(), config.getboolean("enable_force_move", False))
    force_move.register_commands()
    return force_move
