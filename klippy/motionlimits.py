"""What numbers of motion may be: one range for the parameter of a command and for the option of the config.

The ranges are far wider than any machine. Inside them no square overflows or vanishes, no move lasts for ever, and the
steps of a move fit into memory. Use: `gcmd.get_float("SPEED", 5.0, **SPEED)`, `config.getfloat("speed", **SPEED)`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from gcode_command import CommandError

Range = dict[str, Any]

MIN_SPEED = 1e-3
SPEED: Range = {"minval": MIN_SPEED, "maxval": 1e6}  # mm/s, or rad/s
ACCEL: Range = {"minval": 1e-3, "maxval": 1e8}  # mm/s^2
CORNER_SPEED: Range = {"minval": 0.0, "maxval": 1e6}  # mm/s
POSITION: Range = {"minval": -1e5, "maxval": 1e5}  # mm: 100 m to both sides
TRAVEL: Range = {"minval": -1e9, "maxval": 1e9}  # mm, of an axis: an endless belt has no end
LENGTH: Range = {"minval": 0.0, "maxval": 1e5}  # mm
DIAMETER: Range = {"minval": 1e-2, "maxval": 1e3}  # mm, of nozzle and filament (or paste)
PERCENT: Range = {"minval": 0.1, "maxval": 1e5}  # of M220, M221
DWELL_MS: Range = {"minval": 0.0, "maxval": 1e9}  # 11 days
PRESSURE_ADVANCE: Range = {"minval": 0.0, "maxval": 10.0}  # s; a long Bowden tube needs about 1
SHAPER_HZ: Range = {"minval": 1.0, "maxval": 1e4}
DAMPING_RATIO: Range = {"minval": 0.0, "maxval": 0.99}  # the shaper's time grows with 1 / sqrt(1 - ratio^2)
# Steps finer than this come from a wrong option: 256 microsteps of a geared leadscrew are some 1e-5 mm.
STEP_MIN, STEP_MIN_RAD, STEP_MAX = 1e-6, 1e-9, 1e3  # mm, rad, mm or rad
STEPS_MAX = 1_000_000  # microsteps, and full steps per rotation
# A motor moved by itself gets the steps of the whole move at once: at 8 bytes each, this many are 160 MB.
MOVE_STEPS = 2e7
# (sqrt(2) - 1) relates the corner deviation to the speed of a right angle: sin(45)/(1 - sin(45)) = 1/(sqrt(2) - 1)
RIGHT_ANGLE_FACTOR = math.sqrt(2.0) - 1.0


def or_zero(get: Callable[..., Any], name: str, default: float, allowed: Range) -> float:
    """A number that is in its range or 0 (which means: none); `get`: gcmd.get_float or config.getfloat."""
    if get(name, default, minval=0.0):
        return float(get(name, default, **allowed))
    return 0.0


def too_slow(speed: float) -> CommandError:
    """The error of a move below MIN_SPEED. (One that is too fast is slowed down to what the machine can.)"""
    return CommandError(f"Move too slow: {speed:g} mm/s; it must have minimum of {MIN_SPEED:g} mm/s")


def check_way(name: str, way: float, step: float = math.inf) -> None:
    """Raise if a motor would go too far in one move. `way` in mm or rad, `step` of a motor that moves by itself."""
    longest = min(POSITION["maxval"], MOVE_STEPS * step)
    if not abs(way) <= longest:
        raise CommandError(f"Move of {name} too long: {way:g} mm; it must have maximum of {longest:g} mm")


def check_rotation_distance(distance: float, steps_per_rotation: float) -> None:
    """Raise if one step (mm) would be out of range."""
    low, high = STEP_MIN * steps_per_rotation, STEP_MAX * steps_per_rotation
    if not low <= abs(distance) <= high:
        raise CommandError(
            f"Rotation distance {distance:g} out of range: this motor can have {low:g} to {high:g} mm"
        )


def check_step(config: Any, rotation_dist: float, steps_per_rotation: float, in_radians: bool) -> None:
    """Raise if one step of a stepper section is out of range; rotation_dist in mm or rad."""
    low = STEP_MIN_RAD if in_radians else STEP_MIN
    if not low * steps_per_rotation <= rotation_dist <= STEP_MAX * steps_per_rotation:
        unit, option = ("rad", "gear_ratio") if in_radians else ("mm", "rotation_distance")
        raise config.error(
            f"Section '{config.get_name()}': {steps_per_rotation:g} steps for {rotation_dist:g} {unit}; one step can "
            f"be {low:g} to {STEP_MAX:g} {unit}. Check rotation_distance, microsteps, full_steps_per_rotation and "
            f"gear_ratio ({config.where(option)})."
        )


@dataclass(frozen=True, slots=True)
class VelocityLimits:
    """What the look-ahead keeps to. mm/s, mm/s^2."""

    velocity: float
    accel: float
    cruise_ratio: float
    corner_velocity: float

    @property
    def junction_deviation(self) -> float:
        return self.corner_velocity**2 * RIGHT_ANGLE_FACTOR / self.accel

    @property
    def accel_to_decel(self) -> float:
        return self.accel * (1.0 - self.cruise_ratio)

    def describe(self) -> str:
        return (
            f"max_velocity: {self.velocity:.6f}\nmax_accel: {self.accel:.6f}\n"
            f"minimum_cruise_ratio: {self.cruise_ratio:.6f}\n"
            f"square_corner_velocity: {self.corner_velocity:.6f}"
        )


def read_velocity_limits(config: Any) -> VelocityLimits:
    """Of section [printer]."""
    velocity, accel = config.getfloat("max_velocity", **SPEED), config.getfloat("max_accel", **ACCEL)
    usual_ratio = 0.5
    to_decel = config.getfloat("max_accel_to_decel", None, **ACCEL)  # before it was a ratio
    if to_decel is not None:
        config.deprecate("max_accel_to_decel")
        usual_ratio = 1.0 - min(1.0, to_decel / accel)
    ratio = config.getfloat("minimum_cruise_ratio", usual_ratio, minval=0.0, below=1.0)
    return VelocityLimits(
        velocity, accel, ratio, config.getfloat("square_corner_velocity", 5.0, **CORNER_SPEED)
    )


def parse_m204(gcmd: Any) -> dict[str, float]:
    """M204 S<accel>, or P<print> T<travel>: the lower of both. Slicers also send P or T alone, for a kind of move that
    has no limit of its own here: that changes nothing."""
    accel = gcmd.get_float("S", None, **ACCEL)
    if accel is None:
        printing, travel = gcmd.get_float("P", None, **ACCEL), gcmd.get_float("T", None, **ACCEL)
        if printing is None or travel is None:
            return {}
        accel = min(printing, travel)
    return {"accel": accel}


def parse_set_velocity_limit(gcmd: Any, accel: float) -> dict[str, float]:
    """Fields of VelocityLimits that are given; `accel`: the one in force."""
    given = {
        "velocity": gcmd.get_float("VELOCITY", None, **SPEED),
        "accel": gcmd.get_float("ACCEL", None, **ACCEL),
        "corner_velocity": gcmd.get_float("SQUARE_CORNER_VELOCITY", None, **CORNER_SPEED),
        "cruise_ratio": gcmd.get_float("MINIMUM_CRUISE_RATIO", None, minval=0.0, below=1.0),
    }
    to_decel = gcmd.get_float("ACCEL_TO_DECEL", None, **ACCEL)
    if given["cruise_ratio"] is None and to_decel is not None:
        given["cruise_ratio"] = 1.0 - min(1.0, to_decel / (given["accel"] or accel))
    return {name: value for name, value in given.items() if value is not None}


class VelocityLimited:
    """The part of a toolhead that keeps its limits, and the commands that change them."""

    printer: Any
    max_velocity: float
    max_accel: float
    min_cruise_ratio: float
    square_corner_velocity: float
    junction_deviation: float
    max_accel_to_decel: float

    def _velocity_limits(self) -> VelocityLimits:
        return VelocityLimits(
            self.max_velocity, self.max_accel, self.min_cruise_ratio, self.square_corner_velocity
        )

    def _set_limits(self, limits: VelocityLimits) -> None:
        self.max_velocity, self.max_accel = limits.velocity, limits.accel
        self.min_cruise_ratio, self.square_corner_velocity = limits.cruise_ratio, limits.corner_velocity
        self.junction_deviation, self.max_accel_to_decel = limits.junction_deviation, limits.accel_to_decel

    def _calc_junction_deviation(self) -> None:
        """A plugin has set limits by their attributes."""
        self._set_limits(self._velocity_limits())

    def get_max_velocity(self) -> tuple[float, float]:
        """(mm/s, mm/s^2)."""
        return self.max_velocity, self.max_accel

    def set_max_velocities(
        self,
        max_velocity: float | None,
        max_accel: float | None,
        square_corner_velocity: float | None,
        min_cruise_ratio: float | None,
    ) -> tuple[float, float, float, float]:
        """Plugins change limits so (None: keep); returns those in force."""
        given = {
            "velocity": max_velocity,
            "accel": max_accel,
            "corner_velocity": square_corner_velocity,
            "cruise_ratio": min_cruise_ratio,
        }
        new = self._change_limits({name: value for name, value in given.items() if value is not None})
        return new.velocity, new.accel, new.corner_velocity, new.cruise_ratio

    def cmd_M204(self, gcmd: Any) -> None:
        """M204 S<accel>, or P<print> T<travel>."""
        self._change_limits(parse_m204(gcmd))

    def cmd_SET_VELOCITY_LIMIT(self, gcmd: Any) -> None:
        """SET_VELOCITY_LIMIT VELOCITY= ACCEL= MINIMUM_CRUISE_RATIO= SQUARE_CORNER_VELOCITY=; without any: report."""
        changes = parse_set_velocity_limit(gcmd, self.max_accel)
        text = self._change_limits(changes).describe()
        self.printer.set_rollover_info("toolhead", f"toolhead: {text}")
        if not changes:
            gcmd.respond_info(text, log=False)

    def _change_limits(self, changes: dict[str, float]) -> VelocityLimits:
        limits = replace(self._velocity_limits(), **changes)
        self._set_limits(limits)
        return limits
