"""Extruders: filament motion with pressure advance, limits on extrusion, and the hotend's temperature commands.

An extruder has a motion queue of its own, in which the filament fed is coordinate 0 (see kin_extruder.c).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import chelper
import motionlimits
import stepper
import stepstream
from lookahead import Move, done_in_c
from motionlimits import ACCEL, CORNER_SPEED, DIAMETER, LENGTH, PRESSURE_ADVANCE, SPEED

# Wide extrusion means a typing error: more than this many nozzle diameters squared (documented default).
DEFAULT_CROSS_SECTION_FACTOR = 4.0
DEFAULT_MAX_EXTRUDE_ONLY_MM = 50.0
DEFAULT_CORNER_VELOCITY = 1.0
DEFAULT_SMOOTH_TIME_S = 0.040
MAX_SMOOTH_TIME_S = 0.200

# Default of max_extrude_only_*: what the head's limits mean for filament at the largest allowed cross section.


class ExtruderStepper:
    """The motor of an extruder; may follow another extruder's motion queue."""

    def __init__(self, config: Any) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name().split()[-1]
        self.pressure_advance = 0.0
        self.pressure_advance_smooth_time = 0.0
        self.config_pa = config.getfloat("pressure_advance", 0.0, **PRESSURE_ADVANCE)
        self.config_smooth_time = config.getfloat(
            "pressure_advance_smooth_time", DEFAULT_SMOOTH_TIME_S, above=0.0, maxval=MAX_SMOOTH_TIME_S
        )
        self.motion_queue: str | None = None
        _ffi, self._lib = chelper.get_ffi()
        self.stepper = stepper.PrinterStepper(config)
        self.stepper.setup_itersolve("extruder_stepper_alloc")
        self.printer.register_event_handler("klippy:connect", self._handle_connect)
        self._register_commands()

    def _register_commands(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        if self.name == "extruder":
            gcode.register_mux_command(
                "SET_PRESSURE_ADVANCE", "EXTRUDER", None, self.cmd_default_SET_PRESSURE_ADVANCE,
                desc=self.cmd_SET_PRESSURE_ADVANCE_help,
            )  # fmt: skip
        for name in ("SET_PRESSURE_ADVANCE", "SET_EXTRUDER_ROTATION_DISTANCE", "SYNC_EXTRUDER_MOTION"):
            gcode.register_mux_command(
                name,
                "EXTRUDER",
                self.name,
                getattr(self, f"cmd_{name}"),
                desc=getattr(self, f"cmd_{name}_help"),
            )

    def _handle_connect(self) -> None:
        self._set_pressure_advance(self.config_pa, self.config_smooth_time)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {
            "pressure_advance": self.pressure_advance,
            "smooth_time": self.pressure_advance_smooth_time,
            "motion_queue": self.motion_queue,
        }

    def find_past_position(self, print_time: float) -> float:
        """Filament position (mm) at a time in the last half minute."""
        return self.stepper.mcu_to_commanded_position(self.stepper.get_past_mcu_position(print_time))

    def sync_to_extruder(self, extruder_name: str | None) -> None:
        """Follow the motion of an extruder; None or '': rest."""
        self.printer.lookup_object("toolhead").flush_step_generation()
        if not extruder_name:
            self.stepper.set_trapq(None)
            self.motion_queue = None
            return
        extruder = self.printer.lookup_object(extruder_name, None)
        if not isinstance(extruder, PrinterExtruder):
            raise self.printer.command_error(f"'{extruder_name}' is not a valid extruder.")
        self.stepper.set_position([extruder.last_position, 0.0, 0.0])
        self.stepper.set_trapq(extruder.get_trapq())
        self.motion_queue = extruder_name

    def _set_pressure_advance(self, pressure_advance: float, smooth_time: float) -> None:
        toolhead = self.printer.lookup_object("toolhead", None)
        if toolhead is not None:
            toolhead.flush_step_generation()
        self._lib.extruder_set_pressure_advance(
            self.stepper.get_stepper_kinematics(), pressure_advance, smooth_time
        )
        self.pressure_advance = pressure_advance
        self.pressure_advance_smooth_time = smooth_time

    cmd_SET_PRESSURE_ADVANCE_help = "Set pressure advance parameters"

    def cmd_default_SET_PRESSURE_ADVANCE(self, gcmd: Any) -> None:
        """Without EXTRUDER: the active one."""
        extruder = self.printer.lookup_object("toolhead").get_extruder()
        motor = getattr(extruder, "extruder_stepper", None)
        if motor is None:
            raise gcmd.error("Active extruder does not have a stepper")
        motor.cmd_SET_PRESSURE_ADVANCE(gcmd)

    def cmd_SET_PRESSURE_ADVANCE(self, gcmd: Any) -> None:
        """SET_PRESSURE_ADVANCE [EXTRUDER=] [ADVANCE=s] [SMOOTH_TIME=s]."""
        advance = gcmd.get_float("ADVANCE", self.pressure_advance, **PRESSURE_ADVANCE)
        smooth_time = gcmd.get_float(
            "SMOOTH_TIME", self.pressure_advance_smooth_time, minval=0.0, maxval=MAX_SMOOTH_TIME_S
        )
        self._set_pressure_advance(advance, smooth_time)
        text = f"pressure_advance: {advance:.6f}\npressure_advance_smooth_time: {smooth_time:.6f}"
        self.printer.set_rollover_info(self.name, f"{self.name}: {text}")
        gcmd.respond_info(text, log=False)

    cmd_SET_EXTRUDER_ROTATION_DISTANCE_help = "Set extruder rotation distance"

    def cmd_SET_EXTRUDER_ROTATION_DISTANCE(self, gcmd: Any) -> None:
        """SET_EXTRUDER_ROTATION_DISTANCE EXTRUDER= [DISTANCE=mm]; negative: the other direction."""
        distance = gcmd.get_float("DISTANCE", None)
        if distance is not None:
            if not distance:
                raise gcmd.error("Rotation distance can not be zero")
            motionlimits.check_rotation_distance(distance, self.stepper.get_rotation_distance()[1])
            self.printer.lookup_object("toolhead").flush_step_generation()
            _inverted, configured = self.stepper.get_dir_inverted()
            self.stepper.set_dir_inverted(configured ^ (distance < 0.0))
            self.stepper.set_rotation_distance(abs(distance))
        current, _steps = self.stepper.get_rotation_distance()
        inverted, configured = self.stepper.get_dir_inverted()
        if inverted != configured:
            current = -current
        gcmd.respond_info(f"Extruder '{self.name}' rotation distance set to {current:.6f}")

    cmd_SYNC_EXTRUDER_MOTION_help = "Set extruder stepper motion queue"

    def cmd_SYNC_EXTRUDER_MOTION(self, gcmd: Any) -> None:
        """SYNC_EXTRUDER_MOTION EXTRUDER= MOTION_QUEUE=extruder name or nothing."""
        self.sync_to_extruder(gcmd.get("MOTION_QUEUE"))
        gcmd.respond_info(f"Extruder '{self.name}' now syncing with '{self.motion_queue}'")


class PrinterExtruder:
    """`[extruder]`, `[extruder1]`, …: a hotend with or without a motor."""

    def __init__(self, config: Any, extruder_num: int) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name()
        self.last_position = 0.0
        self.heater = self._setup_heater(config, extruder_num)
        self._read_limits(config)
        self.trapq = stepstream.lookup_streams(self.printer).new_trapq()
        _ffi, self._lib = chelper.get_ffi()
        self._trapq_append = self._lib.trapq_append
        self.extruder_stepper: ExtruderStepper | None = None
        if any(
            config.get(option, None) is not None for option in ("step_pin", "dir_pin", "rotation_distance")
        ):
            self.extruder_stepper = ExtruderStepper(config)
            self.extruder_stepper.stepper.set_trapq(self.trapq)
            self.extruder_stepper.motion_queue = self.name
        self._register_commands(extruder_num)

    def _setup_heater(self, config: Any, extruder_num: int) -> Any:
        shared = config.get("shared_heater", None)
        heaters = self.printer.load_object(config, "heaters")
        if shared is not None:
            config.deprecate("shared_heater")
            return heaters.lookup_heater(shared)
        return heaters.setup_heater(config, f"T{extruder_num}")

    def _read_limits(self, config: Any) -> None:
        self.nozzle_diameter = config.getfloat("nozzle_diameter", **DIAMETER)
        filament_diameter = config.getfloat(
            "filament_diameter", minval=self.nozzle_diameter, maxval=DIAMETER["maxval"]
        )
        self.filament_area = math.pi * (0.5 * filament_diameter) ** 2
        usual_mm2 = DEFAULT_CROSS_SECTION_FACTOR * self.nozzle_diameter**2
        cross_section = config.getfloat("max_extrude_cross_section", usual_mm2, above=0.0)
        self.max_extrude_ratio = cross_section / self.filament_area
        usual_ratio = usual_mm2 / self.filament_area  # retractions do not get faster by a wider limit
        toolhead = self.printer.lookup_object("toolhead")
        max_velocity, max_accel = toolhead.get_max_velocity()
        self.max_e_velocity = config.getfloat(
            "max_extrude_only_velocity", max_velocity * usual_ratio, **SPEED
        )
        self.max_e_accel = config.getfloat("max_extrude_only_accel", max_accel * usual_ratio, **ACCEL)
        self.max_e_dist = config.getfloat("max_extrude_only_distance", DEFAULT_MAX_EXTRUDE_ONLY_MM, **LENGTH)
        self.instant_corner_v = config.getfloat(
            "instantaneous_corner_velocity", DEFAULT_CORNER_VELOCITY, **CORNER_SPEED
        )

    def _register_commands(self, extruder_num: int) -> None:
        toolhead = self.printer.lookup_object("toolhead")
        gcode = self.printer.lookup_object("gcode")
        if self.name == "extruder":
            toolhead.set_extruder(self, 0.0)
            gcode.register_command("M104", self.cmd_M104)
            gcode.register_command("M109", self.cmd_M109)
        gcode.register_command(f"T{extruder_num}", self.cmd_activate)
        gcode.register_mux_command(
            "ACTIVATE_EXTRUDER", "EXTRUDER", self.name, self.cmd_activate, desc="Change the active extruder"
        )

    # -- facts --

    def get_name(self) -> str:
        return self.name

    def get_heater(self) -> Any:
        return self.heater

    def get_trapq(self) -> Any:
        return self.trapq

    def get_axis_gcode_id(self) -> str:
        return "E"

    def get_status(self, eventtime: float) -> dict[str, Any]:
        status = dict(self.heater.get_status(eventtime))
        status["can_extrude"] = self.heater.can_extrude
        if self.extruder_stepper is not None:
            status.update(self.extruder_stepper.get_status(eventtime))
        return status

    def stats(self, eventtime: float) -> tuple[bool, str]:
        return self.heater.stats(eventtime)

    # -- moves --

    @done_in_c
    def check_move(self, move: Move) -> None:
        """Raise if the move extrudes cold, too much or too far; slow down moves of the extruder alone."""
        problem = self._lib.move_check_filament(move.record, [self.filament_limits()])
        if problem == self._lib.FILAMENT_COLD:
            raise self.printer.command_error(
                "Extrude below minimum temp\nSee the 'min_extrude_temp' config option for details"
            )
        if problem == self._lib.FILAMENT_TOO_MUCH:
            area = move.axes_r[3] * self.filament_area
            raise self.printer.command_error(
                f"Move exceeds maximum extrusion ({area:.3f}mm^2 vs "
                f"{self.max_extrude_ratio * self.filament_area:.3f}mm^2)\n"
                "See the 'max_extrude_cross_section' config option for details"
            )
        if problem == self._lib.FILAMENT_TOO_FAR:
            raise self.printer.command_error(
                f"Extrude only move too long ({move.axes_d[3]:.3f}mm vs {self.max_e_dist:.3f}mm)\n"
                "See the 'max_extrude_only_distance' config option for details"
            )

    def filament_limits(self) -> tuple[float, ...]:
        """struct filament_limits."""
        return (
            self.heater.can_extrude, self.nozzle_diameter, self.max_extrude_ratio, self.max_e_velocity,
            self.max_e_accel, self.max_e_dist, self.instant_corner_v,
        )  # fmt: skip

    @done_in_c
    def calc_junction(self, prev_move: Move, move: Move) -> float:
        """Highest squared speed at the junction: the filament's speed may jump by instant_corner_v at most."""
        return self._lib.move_filament_v2(prev_move.record, move.record, self.instant_corner_v)

    @done_in_c
    def process_move(self, print_time: float, move: Move) -> None:
        """Queue the filament's part of a planned move."""
        ratio = move.axes_r[3]
        advances = 1.0 if ratio > 0.0 and (move.axes_d[0] or move.axes_d[1]) else 0.0
        self._trapq_append(
            self.trapq, print_time, move.accel_t, move.cruise_t, move.decel_t,
            self.last_position, 0.0, 0.0, ratio, advances, 0.0, move.start_v, move.cruise_v, move.accel,
        )  # fmt: skip
        self.last_position += move.axes_d[3]

    def find_past_position(self, print_time: float) -> float:
        if self.extruder_stepper is None:
            return 0.0
        return self.extruder_stepper.find_past_position(print_time)

    # -- commands --

    def _addressed(self, gcmd: Any) -> Any:
        """The extruder T<index> names; the active one without."""
        index = gcmd.get_int("T", None, minval=0)
        if index is None:
            return self.printer.lookup_object("toolhead").get_extruder()
        extruder = self.printer.lookup_object(f"extruder{index}" if index else "extruder", None)
        if extruder is None:
            raise gcmd.error(f"{gcmd.get_command()}: extruder T{index} is not configured")
        return extruder

    def cmd_M104(self, gcmd: Any, wait: bool = False) -> None:
        """M104 [T<index>] [S<temperature>]: set the hotend's target."""
        temp_c = gcmd.get_float("S", 0.0)
        extruder = self._addressed(gcmd)
        heaters = self.printer.lookup_object("heaters")
        heaters.set_temperature(extruder.get_heater(), temp_c, wait)

    def cmd_M109(self, gcmd: Any) -> None:
        """As M104, and wait."""
        self.cmd_M104(gcmd, wait=True)

    def cmd_activate(self, gcmd: Any) -> None:
        """T<index>, ACTIVATE_EXTRUDER EXTRUDER=<name>."""
        toolhead = self.printer.lookup_object("toolhead")
        if toolhead.get_extruder() is self:
            gcmd.respond_info(f"Extruder {self.name} already active")
            return
        gcmd.respond_info(f"Activating extruder {self.name}")
        toolhead.flush_step_generation()
        toolhead.set_extruder(self, self.last_position)
        self.printer.send_event("extruder:activate_extruder")


class DummyExtruder:
    """Stands in while no extruder is configured: refuses to extrude."""

    def __init__(self, printer: Any) -> None:
        self.printer = printer

    def update_move_time(self, flush_time: float, clear_history_time: float) -> None:
        """Nothing is kept."""

    def filament_limits(self) -> tuple[float, ...]:
        """struct filament_limits: nothing may be extruded, and nothing is slowed down for it."""
        return (0.0,) * 6 + (math.inf,)

    @done_in_c
    def check_move(self, move: Move) -> None:
        raise move.move_error("Extrude when no extruder present")

    def find_past_position(self, print_time: float) -> float:
        return 0.0

    @done_in_c
    def calc_junction(self, prev_move: Move, move: Move) -> float:
        return move.max_cruise_v2

    @done_in_c
    def process_move(self, print_time: float, move: Move) -> None:
        """Never reached: check_move refuses."""

    def get_name(self) -> str:
        return ""

    def get_heater(self) -> Any:
        raise self.printer.command_error("Extruder not configured")

    def get_trapq(self) -> Any:
        raise self.printer.command_error("Extruder not configured")


def extruder_sections(config: Any) -> Sequence[str]:
    """'extruder', 'extruder1', … as far as they exist without a gap."""
    names = []
    for number in range(99):
        name = f"extruder{number}" if number else "extruder"
        if not config.has_section(name):
            break
        names.append(name)
    return names


def add_printer_objects(config: Any) -> None:
    printer = config.get_printer()
    for number, name in enumerate(extruder_sections(config)):
        printer.add_object(name, PrinterExtruder(config.getsection(name), number))
