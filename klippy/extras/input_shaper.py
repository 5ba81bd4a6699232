"""Input shaping: each axis is moved as a sum of copies of itself, so that the ringing each copy starts cancels out.

The copies are the impulses of vibration/shapers.py, shifted so that their mean time is 0: the head is neither early
nor late against the extruder.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import chelper
from configfile import ConfigWrapper
from gcode import GCodeCommand
from motionlimits import DAMPING_RATIO, SHAPER_HZ, or_zero
from roles import Printer
from vibration import shapers

AXES = "xyz"
DEFAULT_TYPE = "mzv"
DEFAULT_DAMPING_RATIO = 0.1

Pulses = tuple[list[float], list[float]]  # weights (sum 1), times in s


@dataclass(frozen=True, slots=True)
class AxisShaper:
    """Parameters of one axis; frequency_hz 0: not shaped."""

    axis: str
    shaper: shapers.Shaper
    frequency_hz: float
    damping_ratio: float

    @property
    def kind(self) -> str:
        """The type as the user wrote it."""
        return self.shaper.text

    def pulses(self) -> Pulses:
        """(weights, delays in s with mean 0); empty if not shaped."""
        if not self.frequency_hz:
            return [], []
        weights, times = self.shaper.pulses(self.frequency_hz, self.damping_ratio)
        mean = sum(w * t for w, t in zip(weights, times, strict=True))
        return weights, [t - mean for t in times]

    def describe(self) -> str:
        return (
            f"shaper_type_{self.axis}:{self.kind} shaper_freq_{self.axis}:{self.frequency_hz:.3f} "
            f"damping_ratio_{self.axis}:{self.damping_ratio:.6f}"
        )


class InputShaper:
    """Printer object 'input_shaper'."""

    def __init__(self, printer: Printer, axes: list[AxisShaper]) -> None:
        self.printer = printer
        self.axes = axes
        self._ffi, self._lib = chelper.get_ffi()

    def register(self) -> None:
        self.printer.register_event_handler("klippy:connect", self._handle_connect)
        self.printer.register_event_handler("dual_carriage:update_kinematics", self.enable_shaping)
        self.printer.lookup_object("gcode").register_command(
            "SET_INPUT_SHAPER", self.cmd_SET_INPUT_SHAPER, desc="Set cartesian parameters for input shaper"
        )

    def _handle_connect(self) -> None:
        self._set_pulses(self.axes)

    def disable_shaping(self) -> None:
        self._apply([replace(a, frequency_hz=0.0) for a in self.axes])

    def enable_shaping(self) -> None:
        self._apply(self.axes)

    def _apply(self, axes: list[AxisShaper]) -> None:
        """From the next motion on; the toolhead begins it late enough for its first copy."""
        self.printer.lookup_object("toolhead").flush_step_generation()
        self._set_pulses(axes)

    def _set_pulses(self, axes: list[AxisShaper]) -> None:
        """Give every motor of the kinematics the pulses of the axes that turn it."""
        toolhead = self.printer.lookup_object("toolhead")
        for axis in axes:
            weights, delays = axis.pulses()
            for motor in toolhead.get_kinematics().get_steppers():
                self._lib.itersolve_set_shaper(
                    motor.get_stepper_kinematics(), axis.axis.encode(), len(weights),
                    self._ffi.new("double[]", weights or 1), self._ffi.new("double[]", delays or 1),
                )  # fmt: skip

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {
            f"{name}_{a.axis}": value
            for a in self.axes
            for name, value in (
                ("shaper_type", a.kind),
                ("shaper_freq", a.frequency_hz),
                ("damping_ratio", a.damping_ratio),
            )
        }

    def cmd_SET_INPUT_SHAPER(self, gcmd: GCodeCommand) -> None:
        """SET_INPUT_SHAPER [SHAPER_FREQ_X=Hz] [DAMPING_RATIO_X=] [SHAPER_TYPE=|SHAPER_TYPE_X=] … also Y, Z."""
        common = gcmd.get("SHAPER_TYPE", None)
        changed = []
        for axis in self.axes:
            letter = axis.axis.upper()
            kind = gcmd.get(f"SHAPER_TYPE_{letter}", common or axis.kind)
            frequency = or_zero(gcmd.get_float, f"SHAPER_FREQ_{letter}", axis.frequency_hz, SHAPER_HZ)
            damping = gcmd.get_float(f"DAMPING_RATIO_{letter}", axis.damping_ratio, **DAMPING_RATIO)
            try:
                changed.append(make_axis(axis.axis, kind, frequency, damping))
            except ValueError as e:
                raise gcmd.error(f"SET_INPUT_SHAPER: {e}.") from None
        if changed != self.axes:
            self._apply(changed)
            self.axes = changed
        for axis in self.axes:
            if axis.axis != "z" or axis.frequency_hz:
                gcmd.respond_info(axis.describe())


def make_axis(axis: str, kind: str, frequency_hz: float, damping_ratio: float) -> AxisShaper:
    """Raises ValueError if the type is unknown, or does not hold for the damping ratio of a shaped axis."""
    shaper = shapers.parse(kind)
    if frequency_hz:
        shapers.check_damping(shaper, damping_ratio)
    return AxisShaper(axis, shaper, frequency_hz, damping_ratio)


def _read_axis(config: ConfigWrapper, axis: str) -> AxisShaper:
    common = config.get("shaper_type", DEFAULT_TYPE)
    own = f"shaper_type_{axis}"
    kind = config.get(own, common)
    frequency_hz = or_zero(config.getfloat, f"shaper_freq_{axis}", 0.0, SHAPER_HZ)
    damping_ratio = config.getfloat(f"damping_ratio_{axis}", DEFAULT_DAMPING_RATIO, **DAMPING_RATIO)
    try:
        return make_axis(axis, kind, frequency_hz, damping_ratio)
    except ValueError as e:
        option = own if config.get(own, None) is not None else "shaper_type"
        raise config.error(
            f"Option '{option}' in section '{config.get_name()}' ({config.where(option)}): {e}."
        ) from None


def load_config(config: ConfigWrapper) -> InputShaper:
    shaper = InputShaper(config.get_printer(), [_read_axis(config, axis) for axis in AXES])
    shaper.register()
    return shaper
