"""[manual_stepper NAME]: a motor beside the kinematics. MANUAL_STEPPER moves it, or makes it an axis of G1.

It has a motion queue of its own, in which its position is coordinate x. For homing moves it stands in for the
toolhead and its kinematics at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import chelper
import stepper
import stepstream
from configfile import ConfigWrapper
from gcode import GCodeCommand
from motionlimits import ACCEL, CORNER_SPEED, POSITION, SPEED, check_way, or_zero

from .force_move import trapezoid

DEFAULT_SPEED_MM_S = 5.0
DEFAULT_CORNER_VELOCITY = 1.0
# Letters of G1 that mean something already.
TAKEN_LETTERS = "XYZEFN"


@dataclass(slots=True)
class AxisLimits:
    """As an axis of G1: bounds (mm/s, mm/s^2; None: no bound) and the jump allowed at a junction (mm/s)."""

    velocity: float | None = None
    accel: float | None = None
    corner_velocity: float = DEFAULT_CORNER_VELOCITY


class ManualStepper:
    """Printer object 'manual_stepper NAME'."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.name = config.get_name().split(None, 1)[-1]
        self.mcu = self.printer.lookup_object("mcu")
        self.rail: Any = None
        if config.get("endstop_pin", None) is not None:
            self.rail = stepper.LookupRail(config, need_position_minmax=False, default_position_endstop=0.0)
            self.steppers = self.rail.get_steppers()
        else:
            self.steppers = [stepper.PrinterStepper(config)]
        self.velocity = config.getfloat("velocity", DEFAULT_SPEED_MM_S, **SPEED)
        self.accel = or_zero(config.getfloat, "accel", 0.0, ACCEL)
        self.position_min = config.getfloat("position_min", None, **POSITION)
        self.position_max = config.getfloat("position_max", None, **POSITION)
        if None not in (self.position_min, self.position_max) and self.position_min >= self.position_max:
            raise config.error(
                f"Section '{config.get_name()}': position_min {self.position_min:g} must be below position_max "
                f"{self.position_max:g}"
            )
        _ffi, self._lib = chelper.get_ffi()
        self._streams = stepstream.lookup_streams(self.printer)
        self._trapq = self._streams.new_trapq()
        for motor in self.steppers:
            motor.setup_itersolve("cartesian_stepper_alloc", b"x")
            motor.set_trapq(self._trapq)
        self._position = 0.0
        self._end_time = 0.0  # print_time at which its last motion ends
        self._homing_accel = 0.0
        self._axis_letter = ""
        self._limits = AxisLimits()

    def register(self) -> None:
        """Commands and events."""
        self.printer.lookup_object("gcode").register_mux_command(
            "MANUAL_STEPPER", "STEPPER", self.name, self.cmd_MANUAL_STEPPER,
            desc="Command a manually configured stepper",
        )  # fmt: skip
        self.printer.register_event_handler("gcode:request_restart", self._handle_request_restart)

    def _handle_request_restart(self, print_time: float) -> None:
        self.sync_print_time()

    def get_status(self, eventtime: float) -> dict[str, Any]:
        enable = self.printer.lookup_object("stepper_enable")
        names = [motor.get_name() for motor in self.steppers]
        return {
            "position": self._position,
            "enabled": all(enable.lookup_enable(name).is_motor_enabled() for name in names),
        }

    def _toolhead(self) -> Any:
        return self.printer.lookup_object("toolhead")

    # -- motion of its own --

    def sync_print_time(self) -> None:
        """Bring the head's time and this motor's together: whichever is behind waits."""
        toolhead = self._toolhead()
        print_time = toolhead.get_last_move_time()
        if self._end_time > print_time:
            toolhead.dwell(self._end_time - print_time)
        else:
            self._end_time = print_time

    def do_enable(self, enable: bool) -> None:
        self.sync_print_time()
        lookup = self.printer.lookup_object("stepper_enable").lookup_enable
        for line in (lookup(motor.get_name()) for motor in self.steppers):
            (line.motor_enable if enable else line.motor_disable)(self._end_time)

    def do_set_position(self, setpos: float) -> None:
        """Where it stands is called setpos from now on."""
        self.sync_print_time()
        self.flush_step_generation()
        self._place(self._end_time, setpos)

    def _place(self, print_time: float, position: float) -> None:
        self._lib.trapq_set_position(self._trapq, print_time, position, 0.0, 0.0)
        for motor in self.steppers:
            motor.set_position((position, 0.0, 0.0))
        self._position = position

    def _queue(self, start_time: float, movepos: float, speed: float, accel: float) -> float:
        """A move from rest to rest into the motion queue; returns its end."""
        way = movepos - self._position
        accel_t, cruise_t, top = trapezoid(abs(way), speed, accel)
        self._lib.trapq_append(
            self._trapq, start_time, accel_t, cruise_t, accel_t, self._position, 0.0, 0.0,
            1.0 if way > 0.0 else -1.0, 0.0, 0.0, 0.0 if accel else top, top, accel,
        )  # fmt: skip
        self._position = movepos
        return start_time + accel_t + cruise_t + accel_t

    def do_move(self, movepos: float, speed: float, accel: float, sync: bool = True) -> None:
        """Go to movepos (mm); without sync the head may move at the same time."""
        self._check_range(movepos)
        self.sync_print_time()
        if movepos != self._position:
            self._end_time = self._queue(self._end_time, movepos, speed, accel)
            self._toolhead().note_mcu_movequeue_activity(self._end_time, set_step_gen_time=True)
        if sync:
            self.sync_print_time()

    def do_homing_move(
        self, movepos: float, speed: float, accel: float, triggered: bool, check_trigger: bool
    ) -> None:
        """Go towards movepos until the endstop changes; where it does is movepos."""
        if self.rail is None:
            raise self.printer.command_error("No endstop for this manual stepper")
        self._check_range(movepos)
        self._homing_accel = accel
        homing = self.printer.lookup_object("homing")
        target = [movepos, 0.0, 0.0, 0.0]
        homing.manual_home(self, self.rail.get_endstops(), target, speed, triggered, check_trigger)

    def _check_range(self, position: float) -> None:
        low, high = self.position_min, self.position_max
        if (low is not None and position < low) or (high is not None and position > high):
            raise self.printer.command_error(f"Move out of range: {self.get_name()} {position:.3f}")

    def _check_way(self, way: float) -> None:
        for motor in self.steppers:
            check_way(self.get_name(), way, motor.get_step_dist())

    # -- the toolhead that homing sees --

    def flush_step_generation(self) -> None:
        self._toolhead().flush_step_generation()

    def get_position(self) -> list[float]:
        return [self._position, 0.0, 0.0, 0.0]

    def set_position(self, newpos: Sequence[float], homing_axes: Sequence[int] | str = ()) -> None:
        self.do_set_position(newpos[0])

    def get_last_move_time(self) -> float:
        self.sync_print_time()
        return self._end_time

    def dwell(self, delay: float) -> None:
        self._end_time += max(0.0, delay)
        self.sync_print_time()

    def drip_move(self, newpos: Sequence[float], speed: float, drip_completion: Any) -> None:
        """Steps only just in time, until done or until the completion is set."""
        self.sync_print_time()
        self.flush_step_generation()
        time = self._end_time
        end = self._queue(time, newpos[0], speed, self._homing_accel) if newpos[0] != self._position else time
        time = self._streams.drip(self.mcu, time, end, drip_completion)
        if time < end:  # the rest of the plan is void
            self._lib.trapq_set_position(self._trapq, time, self._position, 0.0, 0.0)
        self._end_time = time
        self.sync_print_time()

    def get_kinematics(self) -> ManualStepper:
        return self

    def get_steppers(self) -> list[Any]:
        return list(self.steppers)

    def calc_position(self, stepper_positions: dict[str, float]) -> list[float]:
        return [stepper_positions[self.steppers[0].get_name()], 0.0, 0.0]

    # -- an axis of G1 --

    def get_name(self) -> str:
        """As `toolhead.extra_axes` names it."""
        return f"manual_stepper {self.name}"

    def get_axis_gcode_id(self) -> str:
        return self._axis_letter

    def get_trapq(self) -> Any:
        return self._trapq

    def check_move(self, move: Any, index: int) -> None:
        """Raise if the axis leaves its range; slow the move down to the axis' bounds."""
        way = move.axes_d[index]
        check_way(self.get_name(), way)
        self._check_range(move.end_pos[index])
        bounds = self._limits
        alone = not move.is_kinematic_move and not move.axes_d[3]
        stretch = move.move_d / abs(way)  # of the path, per mm of this axis
        accel = bounds.accel
        if accel is None and alone:  # it has no other limit
            accel = self.accel or self._toolhead().get_max_velocity()[1]
        if bounds.velocity is not None or accel is not None:
            speed = move.max_cruise_v2**0.5 if bounds.velocity is None else bounds.velocity * stretch
            move.limit_speed(speed, move.accel if accel is None else accel * stretch)

    def calc_junction(self, before: Any, move: Any, index: int) -> float:
        """Highest squared speed at the junction: the axis' speed may jump by corner_velocity at most."""
        ratios = [m.axes_r[index] if index < len(m.axes_r) else 0.0 for m in (before, move)]
        change = abs(ratios[1] - ratios[0])
        if change * move.max_cruise_v2**0.5 <= self._limits.corner_velocity:
            return move.max_cruise_v2
        return (self._limits.corner_velocity / change) ** 2

    def process_move(self, print_time: float, move: Any, index: int) -> None:
        """Queue the axis' part of a planned move."""
        way = move.axes_d[index]
        self._lib.trapq_append(
            self._trapq, print_time, move.accel_t, move.cruise_t, move.decel_t, self._position, 0.0, 0.0,
            way / move.move_d, 0.0, 0.0, move.start_v, move.cruise_v, move.accel,
        )  # fmt: skip
        self._position += way
        self._end_time = print_time + move.accel_t + move.cruise_t + move.decel_t

    def _set_gcode_axis(self, gcmd: GCodeCommand) -> None:
        letter = gcmd.get("GCODE_AXIS").strip().upper()
        toolhead = self._toolhead()
        if not letter:
            self._axis_letter = ""
            toolhead.remove_extra_axis(self)
            return
        if self._axis_letter:
            raise gcmd.error(f"Must unregister axis {self._axis_letter} first")
        if len(letter) != 1 or not "A" <= letter <= "Z" or letter in TAKEN_LETTERS:
            raise gcmd.error(f"Not a valid GCODE_AXIS: '{letter}' (a letter other than {TAKEN_LETTERS})")
        others = toolhead.get_extra_axes()[4:]
        if any(axis.get_axis_gcode_id() == letter for axis in others):
            raise gcmd.error(f"Axis '{letter}' already registered")
        limits = AxisLimits(
            gcmd.get_float("LIMIT_VELOCITY", None, **SPEED),
            gcmd.get_float("LIMIT_ACCEL", None, **ACCEL),
            gcmd.get_float("INSTANTANEOUS_CORNER_VELOCITY", DEFAULT_CORNER_VELOCITY, **CORNER_SPEED),
        )
        self.sync_print_time()
        self._limits, self._axis_letter = limits, letter
        toolhead.add_extra_axis(self, self._position)

    # -- command --

    def cmd_MANUAL_STEPPER(self, gcmd: GCodeCommand) -> None:
        """MANUAL_STEPPER STEPPER= [ENABLE=0|1] [SET_POSITION=mm] [SPEED=] [ACCEL=] [MOVE=mm [STOP_ON_ENDSTOP=1|2|-1|-2]
        [SYNC=0]] or MANUAL_STEPPER STEPPER= GCODE_AXIS=letter [LIMIT_VELOCITY=] [LIMIT_ACCEL=]
        [INSTANTANEOUS_CORNER_VELOCITY=]."""
        if gcmd.get("GCODE_AXIS", None) is not None:
            self._set_gcode_axis(gcmd)
            return
        enable = gcmd.get_int("ENABLE", None, minval=0, maxval=1)
        setpos = gcmd.get_float("SET_POSITION", None, **POSITION)
        speed = gcmd.get_float("SPEED", self.velocity, **SPEED)
        accel = or_zero(gcmd.get_float, "ACCEL", self.accel, ACCEL)
        stop_on = gcmd.get_int("STOP_ON_ENDSTOP", 0, minval=-2, maxval=2)
        sync = bool(gcmd.get_int("SYNC", 1))
        movepos = gcmd.get_float("MOVE", None, **POSITION)
        if self._axis_letter and (setpos is not None or movepos is not None):
            raise gcmd.error(
                f"manual_stepper {self.name} is axis {self._axis_letter} of G1: give it back with GCODE_AXIS= first"
            )
        if movepos is not None:
            self._check_range(movepos)
            self._check_way(movepos - (self._position if setpos is None else setpos))
        if enable is not None:
            self.do_enable(bool(enable))
        if setpos is not None:
            self.do_set_position(setpos)
        if movepos is None:
            if not sync and setpos is None:
                self.sync_print_time()
        elif stop_on:
            self.do_homing_move(movepos, speed, accel, triggered=stop_on > 0, check_trigger=abs(stop_on) == 1)
        else:
            self.do_move(movepos, speed, accel, sync)


def load_config_prefix(config: ConfigWrapper) -> ManualStepper:
    manual = ManualStepper(config)
    manual.register()
    return manual
