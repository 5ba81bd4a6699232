"""Stepper motors: configuration, the link to the C step solver, and rails (steppers with an endstop).

Positions: `mcu position` counts steps, net of the direction pin's inversion; `commanded position` is in mm (radians
for some kinematics) and lies on the grid the stepper can stand on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import chelper
import motionlimits
import stepstream
from link import optional_board
from motionlimits import LENGTH, POSITION, SPEED, TRAVEL

QUEUE_STEP = "queue_step oid=%c interval=%u count=%hu add=%hi"
SET_NEXT_STEP_DIR = "set_next_step_dir oid=%c dir=%c"
RESET_STEP_CLOCK = "reset_step_clock oid=%c clock=%u"

# A typical driver needs 1 us at least (A4988); 2 us is safe for all in use.
DEFAULT_STEP_PULSE_S = 0.000002
# Drivers that step on both edges can be driven without an "unstep" if the pulse may be this short.
BOTH_EDGE_PULSE_S = 0.000000500
MAX_STEP_PULSE_S = 0.001

# Extras that want to know every stepper.
STEPPER_REGISTRARS = ("stepper_enable", "force_move", "motion_report")


class error(Exception):
    """A stepper is used in a way its configuration does not allow."""


class MCU_stepper:
    """One stepper motor on one MCU."""

    def __init__(
        self,
        name: str,
        step_pin_params: dict[str, Any],
        dir_pin_params: dict[str, Any],
        rotation_distance: float,
        steps_per_rotation: float,
        step_pulse_duration: float | None = None,
        units_in_radians: bool = False,
    ) -> None:
        self._name = name
        self._rotation_distance = rotation_distance
        self._steps_per_rotation = steps_per_rotation
        self._step_pulse_duration = step_pulse_duration
        self._units_in_radians = units_in_radians
        self._step_dist = rotation_distance / steps_per_rotation
        self._mcu = step_pin_params["chip"]
        if dir_pin_params["chip"] is not self._mcu:
            raise self._mcu.get_printer().config_error(
                f"Stepper '{name}': step_pin and dir_pin are on different micro-controllers; both must be on the same."
            )
        self._step_pin = step_pin_params["pin"]
        self._invert_step = step_pin_params["invert"]
        self._dir_pin = dir_pin_params["pin"]
        self._orig_invert_dir = self._invert_dir = bool(dir_pin_params["invert"])
        self._step_both_edge = False
        self._want_both_edge = False
        self._oid = self._mcu.create_oid()
        self._mcu.register_config_callback(self._build_config)
        self._mcu.get_printer().register_event_handler("klippy:connect", self._adopt_mcu_position)
        self._active_callbacks: list[Callable[[float], None]] = []
        self._ffi, self._lib = chelper.get_ffi()
        self._stepcompress = self._ffi.gc(
            self._lib.stepcompress_alloc(self._oid), self._lib.stepcompress_free
        )
        self._lib.stepcompress_set_invert_dir(self._stepcompress, self._invert_dir)
        self._solver: Any = None
        self._trapq: Any = None
        self._position_query: Any = None
        self._streams = stepstream.lookup_streams(self._mcu.get_printer())
        self._streams.add_stepper(self)

    # -- facts --

    def get_mcu(self) -> Any:
        return self._mcu

    def get_name(self, short: bool = False) -> str:
        """Section name; with short=True without the leading 'stepper_'."""
        return self._name.removeprefix("stepper_") if short else self._name

    def units_in_radians(self) -> bool:
        return self._units_in_radians

    def get_oid(self) -> int:
        return self._oid

    def get_step_dist(self) -> float:
        """mm (rad) per step."""
        return self._step_dist

    def get_rotation_distance(self) -> tuple[float, float]:
        """(mm per rotation, steps per rotation)."""
        return self._rotation_distance, self._steps_per_rotation

    def set_rotation_distance(self, rotation_dist: float) -> None:
        """Change the scale; the place where the stepper stands keeps its coordinate."""
        self._rotation_distance = rotation_dist
        self._step_dist = rotation_dist / self._steps_per_rotation
        if self._solver is not None:
            self._attach(self._solver)

    def get_pulse_duration(self) -> tuple[float | None, bool]:
        return self._step_pulse_duration, self._step_both_edge

    def setup_default_pulse_duration(self, pulse_duration: float, step_both_edge: bool) -> None:
        """Called by driver modules: the pulse used if the config names none, and whether both edges may step."""
        if self._step_pulse_duration is None:
            self._step_pulse_duration = pulse_duration
        self._want_both_edge = step_both_edge

    def is_dir_inverted(self) -> bool:
        return self._invert_dir

    def get_dir_inverted(self) -> tuple[bool, bool]:
        """(now, as configured)."""
        return self._invert_dir, self._orig_invert_dir

    def set_dir_inverted(self, invert_dir: bool) -> None:
        """Turn the direction pin around from the next command on (or back)."""
        self._invert_dir = bool(invert_dir)
        self._lib.stepcompress_set_invert_dir(self._stepcompress, self._invert_dir)

    def get_stepcompress(self) -> Any:
        return self._stepcompress

    # -- configuration of the MCU --

    def _build_config(self) -> None:
        if self._step_pulse_duration is None:
            self._step_pulse_duration = DEFAULT_STEP_PULSE_S
        invert_step = int(self._invert_step)
        pulse_ticks = self._mcu.seconds_to_clock(self._step_pulse_duration)
        constants = self._mcu.get_constants()
        can_step_both_edges = int(constants.get("STEPPER_STEP_BOTH_EDGE", 0))
        if (
            "STEPPER_OPTIMIZED_UNSTEP" in constants
        ):  # a firmware that makes whole pulses faster than edges (AVR)
            can_step_both_edges = 0
        if self._want_both_edge and can_step_both_edges and self._step_pulse_duration <= BOTH_EDGE_PULSE_S:
            self._step_both_edge = True
            invert_step, pulse_ticks = -1, 0
        self._mcu.add_config_cmd(
            f"config_stepper oid={self._oid} step_pin={self._step_pin} dir_pin={self._dir_pin} "
            f"invert_step={invert_step} step_pulse_ticks={pulse_ticks}"
        )
        self._mcu.add_config_cmd(f"reset_step_clock oid={self._oid} clock=0", on_restart=True)
        tags = [
            self._mcu.lookup_command(f).get_command_tag()
            for f in (QUEUE_STEP, SET_NEXT_STEP_DIR, RESET_STEP_CLOCK)
        ]
        max_error_ticks = self._mcu.seconds_to_clock(self._mcu.get_max_stepper_error())
        self._lib.stepcompress_setup(self._stepcompress, max_error_ticks, *tags)
        self._position_query = self._mcu.lookup_query_command(
            "stepper_get_position oid=%c", "stepper_position oid=%c pos=%i", oid=self._oid
        )

    def _adopt_mcu_position(self) -> None:
        """An MCU that was not reset counts on from the session before: take over its count, the place stays."""
        if not self._mcu.kept_configuration():
            return
        position = self._ask_position()[0]
        self._lib.stepcompress_reset(self._stepcompress, 0, position)
        if self._solver is not None:
            self._lib.itersolve_adopt_steps(self._solver, position)

    def ask_steps(self) -> int:
        """The MCU's count of steps, also of one that is shut down."""
        return self._ask_position()[0]

    def _ask_position(self) -> tuple[int, int]:
        """(steps, clock) as the MCU says."""
        params = self._position_query.send([self._oid])
        position = -params["pos"] if self._invert_dir else params["pos"]
        clock = self._mcu.print_time_to_clock(self._mcu.estimated_print_time(params["#receive_time"]))
        return position, max(0, clock)

    # -- the step solver --

    def setup_itersolve(self, alloc_func: str, *params: Any) -> None:
        """Give the stepper a solver of its own, e.g. setup_itersolve('cartesian_stepper_alloc', b'x')."""
        solver = getattr(self._lib, alloc_func)(*params)
        self.set_stepper_kinematics(self._ffi.gc(solver, self._lib.itersolve_free))

    def get_stepper_kinematics(self) -> Any:
        return self._solver

    def set_stepper_kinematics(self, sk: Any) -> Any:
        """Use another solver; returns the one used before.

        The stepper stays where it is; its coordinate is the one `sk` last had for it (0 if it is new).
        """
        old, self._solver = self._solver, sk
        self._attach(sk)
        if old is not None:
            self._lib.itersolve_adopt_steps(sk, self._lib.itersolve_get_steps(old))
        self._streams.note_kinematics(self)
        self.set_trapq(self._trapq)
        return old

    def _attach(self, sk: Any) -> None:
        self._lib.itersolve_set_stepcompress(sk, self._stepcompress, self._step_dist)

    def get_trapq(self) -> Any:
        return self._trapq

    def set_trapq(self, tq: Any) -> Any:
        """Follow another motion queue (None: rest); returns the one followed before."""
        old, self._trapq = self._trapq, tq
        if self._solver is not None:
            self._lib.itersolve_set_trapq(self._solver, self._ffi.NULL if tq is None else tq)
        return old

    def is_active_axis(self, axis: str) -> bool:
        """Does motion of this coordinate ('x', 'y', 'z') turn the stepper?"""
        return bool(self._lib.itersolve_is_active_axis(self._solver, axis.encode()))

    def add_active_callback(self, cb: Callable[[float], None]) -> None:
        """Call cb(print_time) once, before the next step this stepper makes."""
        self._active_callbacks.append(cb)
        self._streams.note_active_callback(self)

    def wake(self, print_time: float) -> bool:
        """Run the active callbacks if there is motion before print_time; True if there was."""
        if self._solver is None:
            return False
        start = self._lib.itersolve_check_active(self._solver, print_time)
        if start < 0.0:
            return False
        callbacks, self._active_callbacks = self._active_callbacks, []
        for callback in callbacks:
            callback(start)
        return not self._active_callbacks

    def generate_steps(self, flush_time: float) -> None:
        """Steps of all MCUs are worked out together; kept for callers that register a stepper as a generator."""

    # -- positions --

    def calc_position_from_coord(self, coord: Sequence[float]) -> float:
        """Where this stepper would be with the toolhead at (x, y, z)."""
        return self._lib.itersolve_calc_position_from_coord(self._solver, coord[0], coord[1], coord[2])

    def set_position(self, coord: Sequence[float]) -> None:
        """The toolhead is at (x, y, z) now, wherever the stepper stands."""
        self._lib.itersolve_set_position(self._solver, coord[0], coord[1], coord[2])

    def _steps(self) -> int:
        return self._lib.itersolve_get_steps(self._solver) if self._solver is not None else 0

    def get_commanded_position(self) -> float:
        """mm (rad) at which the stepper stands once everything generated is done."""
        return self.mcu_to_commanded_position(self._steps())

    def get_mcu_position(self, cmd_pos: float | None = None) -> int:
        """Steps at a commanded position; by default the current one."""
        if cmd_pos is None or self._solver is None:
            return self._steps()
        return math.floor((cmd_pos - self._lib.itersolve_get_origin(self._solver)) / self._step_dist + 0.5)

    def mcu_to_commanded_position(self, mcu_pos: int) -> float:
        if self._solver is None:
            return mcu_pos * self._step_dist
        return self._lib.itersolve_get_origin(self._solver) + mcu_pos * self._step_dist

    def get_past_mcu_position(self, print_time: float) -> int:
        """Steps at a time in the last half minute."""
        clock = max(0, self._mcu.print_time_to_clock(print_time))
        return self._lib.stepcompress_position_at(self._stepcompress, clock)

    def dump_steps(self, count: int, start_clock: int, end_clock: int) -> tuple[Any, int]:
        """(array of struct step_record, number used) of the commands sent in a range of clocks, oldest first."""
        data = self._ffi.new("struct step_record[]", count)
        used = self._lib.stepcompress_history(
            self._stepcompress, data, count, max(0, start_clock), max(0, end_clock)
        )
        return data, used

    def note_homing_end(self) -> None:
        """The MCU has halted the motor on its own: ask where it stands and go on from there."""
        if self._mcu.is_fileoutput():
            position = self._steps()
            clock = self._lib.stepcompress_last_clock(self._stepcompress)
            self._lib.stepcompress_reset(self._stepcompress, clock, position)
            return
        position, clock = self._ask_position()
        self._lib.stepcompress_reset(self._stepcompress, clock, position)
        if self._solver is not None:
            self._lib.itersolve_set_steps(self._solver, position)


# ---- configuration ----


def parse_gear_ratio(config: Any, note_valid: bool = True) -> float:
    """`gear_ratio: 80:16, 2:1` as one number (10.0): motor turns per turn of the driven part."""
    ratios = config.getlists("gear_ratio", (), seps=(":", ","), count=2, parser=float, note_valid=note_valid)
    total = 1.0
    for driven, driving in ratios:
        if not driven > 0.0 or not driving > 0.0:
            raise config.error(
                f"Option 'gear_ratio' in section '{config.get_name()}' must hold positive numbers"
            )
        total *= driven / driving
    return total


def parse_step_distance(
    config: Any, units_in_radians: bool | None = None, note_valid: bool = False
) -> tuple[float, float]:
    """(rotation_distance in mm or rad, steps per rotation) of a stepper section."""
    if units_in_radians is None:
        units_in_radians = config.get("rotation_distance", None, note_valid=False) is None and (
            config.get("gear_ratio", None, note_valid=False) is not None
        )
    if units_in_radians:
        rotation_dist = 2.0 * math.pi
        config.get("gear_ratio", note_valid=note_valid)
    else:
        rotation_dist = config.getfloat("rotation_distance", above=0.0, note_valid=note_valid)
    microsteps = config.getint("microsteps", minval=1, maxval=motionlimits.STEPS_MAX, note_valid=note_valid)
    full_steps = config.getint(
        "full_steps_per_rotation", 200, minval=1, maxval=motionlimits.STEPS_MAX, note_valid=note_valid
    )
    if full_steps % 4:
        raise config.error(
            f"Option 'full_steps_per_rotation' in section '{config.get_name()}' is {full_steps}; it must be a multiple "
            "of 4 (200 for a motor of 1.8 degrees a step, 400 for 0.9 degrees)."
        )
    steps_per_rotation = full_steps * microsteps * parse_gear_ratio(config, note_valid)
    motionlimits.check_step(config, rotation_dist, steps_per_rotation, units_in_radians)
    return rotation_dist, steps_per_rotation


def PrinterStepper(config: Any, units_in_radians: bool = False) -> MCU_stepper:
    """Make the stepper a section describes and register it with stepper_enable."""
    printer = config.get_printer()
    ppins = printer.lookup_object("pins")
    optional_board.refuse(config, "step_pin")
    step_pin_params = ppins.lookup_pin(config.get("step_pin"), can_invert=True)
    dir_pin_params = ppins.lookup_pin(config.get("dir_pin"), can_invert=True)
    rotation_dist, steps_per_rotation = parse_step_distance(config, units_in_radians, True)
    pulse_duration = config.getfloat("step_pulse_duration", None, minval=0.0, maxval=MAX_STEP_PULSE_S)
    mcu_stepper = MCU_stepper(
        config.get_name(),
        step_pin_params,
        dir_pin_params,
        rotation_dist,
        steps_per_rotation,
        pulse_duration,
        units_in_radians,
    )
    for module in STEPPER_REGISTRARS:
        printer.load_object(config, module).register_stepper(config, mcu_stepper)
    return mcu_stepper


# ---- rails ----


@dataclass(frozen=True, slots=True)
class HomingInfo:
    """How a rail is homed. Speeds mm/s, distances mm."""

    speed: float
    position_endstop: float
    retract_speed: float
    retract_dist: float
    positive_dir: bool
    second_homing_speed: float


def _homing_direction(config: Any, position_min: float, position_max: float, position_endstop: float) -> bool:
    """homing_positive_dir as configured, else towards the end of the axis the endstop is near (a quarter of it)."""
    configured = config.getboolean("homing_positive_dir", None)
    axis_len = position_max - position_min
    if configured is None:
        if position_endstop <= position_min + axis_len / 4.0:
            return False
        if position_endstop >= position_max - axis_len / 4.0:
            return True
        raise config.error(
            f"Unable to infer homing_positive_dir in section '{config.get_name()}': position_endstop "
            f"{position_endstop:g} is near neither end of {position_min:g} .. {position_max:g}. "
            "Set homing_positive_dir."
        )
    if (configured and position_endstop == position_min) or (
        not configured and position_endstop == position_max
    ):
        raise config.error(
            f"Invalid homing_positive_dir / position_endstop in section '{config.get_name()}': homing would drive "
            "away from the endstop."
        )
    return configured


class GenericPrinterRail:
    """An axis with one or more steppers and endstops that moves over [position_min, position_max]."""

    def __init__(
        self,
        config: Any,
        need_position_minmax: bool = True,
        default_position_endstop: float | None = None,
        units_in_radians: bool = False,
    ) -> None:
        self._config = config
        self._config_name = config.get_name()
        self.stepper_units_in_radians = units_in_radians
        self.printer = config.get_printer()
        self.steppers: list[MCU_stepper] = []
        self.endstops: list[tuple[Any, str]] = []
        self._endstop_of_pin: dict[str, Any] = {}
        self._default_endstop_pin = config.get("endstop_pin", None)
        mcu_endstop = self._main_endstop(config)
        self.position_endstop = self._find_position_endstop(config, mcu_endstop, default_position_endstop)
        if need_position_minmax:
            self.position_min = config.getfloat("position_min", 0.0, **TRAVEL)
            self.position_max = config.getfloat("position_max", above=self.position_min, **TRAVEL)
        else:
            self.position_min, self.position_max = 0.0, self.position_endstop
        if not self.position_min <= self.position_endstop <= self.position_max:
            raise config.error(
                f"position_endstop {self.position_endstop:g} in section '{config.get_name()}' must be between "
                f"position_min {self.position_min:g} and position_max {self.position_max:g}"
            )
        self._read_homing(config)

    def _main_endstop(self, config: Any) -> Any:
        """The endstop that has the rail's position_endstop."""
        return self._lookup_endstop(config.get("endstop_pin"), self.get_name(short=True), config)

    @staticmethod
    def _find_position_endstop(config: Any, mcu_endstop: Any, default: float | None) -> float:
        virtual = getattr(
            mcu_endstop, "get_position_endstop", None
        )  # virtual endstops (probes) know their own
        if virtual is not None:
            return virtual()
        if default is None:
            return config.getfloat("position_endstop", **POSITION)
        return config.getfloat("position_endstop", default, **POSITION)

    def _read_homing(self, config: Any) -> None:
        self.homing_speed = config.getfloat("homing_speed", 5.0, **SPEED)
        self.second_homing_speed = config.getfloat("second_homing_speed", self.homing_speed / 2.0, **SPEED)
        self.homing_retract_speed = config.getfloat("homing_retract_speed", self.homing_speed, **SPEED)
        self.homing_retract_dist = config.getfloat("homing_retract_dist", 5.0, **LENGTH)
        self.homing_positive_dir = _homing_direction(
            config, self.position_min, self.position_max, self.position_endstop
        )

    def get_name(self, short: bool = False) -> str:
        return self._config_name.removeprefix("stepper_") if short else self._config_name

    def get_range(self) -> tuple[float, float]:
        return self.position_min, self.position_max

    def get_homing_info(self) -> HomingInfo:
        return HomingInfo(
            self.homing_speed,
            self.position_endstop,
            self.homing_retract_speed,
            self.homing_retract_dist,
            self.homing_positive_dir,
            self.second_homing_speed,
        )

    def get_steppers(self) -> list[MCU_stepper]:
        return list(self.steppers)

    def get_endstops(self) -> list[tuple[Any, str]]:
        """(endstop, name) pairs."""
        return list(self.endstops)

    def _lookup_endstop(self, endstop_pin: str, name: str, config: Any) -> Any:
        """The endstop on a pin; steppers naming the same pin share one."""
        ppins = self.printer.lookup_object("pins")
        params = ppins.parse_pin(endstop_pin, can_invert=True, can_pullup=True)
        key = f"{params['chip_name']}:{params['pin']}"
        if key in self._endstop_of_pin:
            known = self._endstop_of_pin[key]
            if known["invert"] != params["invert"] or known["pullup"] != params["pullup"]:
                raise config.error(
                    f"Section '{config.get_name()}' uses endstop pin '{endstop_pin}' with another inversion or pull-up "
                    f"than the rail '{self.get_name()}' does"
                )
            return known["endstop"]
        mcu_endstop = ppins.setup_pin("endstop", endstop_pin)
        self._endstop_of_pin[key] = {**params, "endstop": mcu_endstop}
        self.endstops.append((mcu_endstop, name))
        query_endstops = self.printer.load_object(config, "query_endstops")
        # clients know endstops by the name of the section; texts for people say 'x'
        prefix = "stepper_" if self._config_name.startswith("stepper_") else ""
        query_endstops.register_endstop(mcu_endstop, prefix + name)
        return mcu_endstop

    def add_stepper(
        self, stepper: MCU_stepper, endstop_pin: str | None = None, endstop_name: str | None = None
    ) -> None:
        """Add a stepper; without a pin of its own it stops on the rail's endstop."""
        self.steppers.append(stepper)
        pin = endstop_pin or self._default_endstop_pin
        if pin is None:
            mcu_endstop = self.endstops[0][0]
        else:
            name = endstop_name or stepper.get_name(short=True)
            mcu_endstop = self._lookup_endstop(pin, name, self._config)
        mcu_endstop.add_stepper(stepper)

    def add_stepper_from_config(self, config: Any) -> None:
        self._add_section(config)

    def _add_section(self, config: Any) -> None:
        stepper = PrinterStepper(config, self.stepper_units_in_radians)
        self.add_stepper(stepper, config.get("endstop_pin", None), stepper.get_name(short=True))

    def setup_itersolve(self, alloc_func: str, *params: Any) -> None:
        for stepper in self.steppers:
            stepper.setup_itersolve(alloc_func, *params)

    def set_trapq(self, trapq: Any) -> None:
        for stepper in self.steppers:
            stepper.set_trapq(trapq)

    def set_position(self, coord: Sequence[float]) -> None:
        for stepper in self.steppers:
            stepper.set_position(coord)

    def generate_steps(self, flush_time: float) -> None:
        for stepper in self.steppers:
            stepper.generate_steps(flush_time)


class PrinterRail(GenericPrinterRail):
    """A rail that begins with the stepper of its own section. Plugins derive from it.

    They override `add_extra_stepper`, which is called for the rail's own section, too. A plugin that puts an endstop of
    its own into `endstops` there needs no `endstop_pin`.
    """

    def _main_endstop(self, config: Any) -> Any:
        self.add_extra_stepper(config)
        return self.endstops[0][0]

    def add_extra_stepper(self, config: Any) -> None:
        """Add the stepper of a section."""
        if not self.endstops:
            config.get("endstop_pin")  # raises if there is none
        self._add_section(config)


LookupRail = PrinterRail


def LookupMultiRail(
    config: Any,
    need_position_minmax: bool = True,
    default_position_endstop: float | None = None,
    units_in_radians: bool = False,
) -> GenericPrinterRail:
    """A rail that also carries the steppers of the sections NAME1, NAME2, … that follow its own."""
    rail = PrinterRail(config, need_position_minmax, default_position_endstop, units_in_radians)
    number = 1
    while config.has_section(f"{config.get_name()}{number}"):
        rail.add_stepper_from_config(config.getsection(f"{config.get_name()}{number}"))
        number += 1
    return rail
