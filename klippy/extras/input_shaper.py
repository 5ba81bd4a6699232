"""Input shaping: each axis is moved as a sum of copies of itself, so that the ringing each copy starts cancels out.

A shaper is a row of pulses (weight, time). With the resonance's frequency f and damping ratio z, the damped period is
T = 1/(f*sqrt(1-z^2)) and half of it damps the ringing by K = exp(-z*pi/sqrt(1-z^2)). The pulses are those of Singer,
Seering and Singhose (ZV, ZVD, EI, two- and three-hump EI), and of the project's documentation (MZV). They are shifted
so that their mean time is 0: the head is neither early nor late against the extruder.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import chelper
from configfile import ConfigWrapper
from gcode import GCodeCommand
from motionlimits import DAMPING_RATIO, SHAPER_HZ, or_zero
from roles import Printer

AXES = "xyz"
DEFAULT_TYPE = "mzv"
DEFAULT_DAMPING_RATIO = 0.1
# Vibration left over that the EI shapers are designed to (share of the unshaped).
EI_TOLERANCE = 0.05

Pulses = tuple[list[float], list[float]]  # weights (sum 1), times in damped periods


def _zv(k: float) -> Pulses:
    return [1.0, k], [0.0, 0.5]


def _mzv(k: float) -> Pulses:
    part = k**0.75  # damping over three eighths of a period
    outer = 1.0 - math.sqrt(0.5)
    return [outer, (math.sqrt(2.0) - 1.0) * part, outer * part * part], [0.0, 0.375, 0.75]


def _zvd(k: float) -> Pulses:
    return [1.0, 2.0 * k, k * k], [0.0, 0.5, 1.0]


def _ei(k: float) -> Pulses:
    outer = 0.25 * (1.0 + EI_TOLERANCE)
    return [outer, 0.5 * (1.0 - EI_TOLERANCE) * k, outer * k * k], [0.0, 0.5, 1.0]


def _two_hump_ei(k: float) -> Pulses:
    v2 = EI_TOLERANCE**2
    x = (v2 * (math.sqrt(1.0 - v2) + 1.0)) ** (1.0 / 3.0)
    outer = (3.0 * x * x + 2.0 * x + 3.0 * v2) / (16.0 * x)
    inner = 0.5 - outer
    return [outer, inner * k, inner * k**2, outer * k**3], [0.0, 0.5, 1.0, 1.5]


def _three_hump_ei(k: float) -> Pulses:
    v = EI_TOLERANCE
    outer = (1.0 + 3.0 * v + 2.0 * math.sqrt(2.0 * (v + v * v))) / 16.0
    inner = 0.25 * (1.0 - v)
    centre = 0.5 * (1.0 + v) - 2.0 * outer
    return [outer, inner * k, centre * k**2, inner * k**3, outer * k**4], [0.0, 0.5, 1.0, 1.5, 2.0]


SHAPERS: dict[str, Callable[[float], Pulses]] = {
    "zv": _zv, "mzv": _mzv, "zvd": _zvd, "ei": _ei, "2hump_ei": _two_hump_ei, "3hump_ei": _three_hump_ei,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class AxisShaper:
    """Parameters of one axis; frequency_hz 0: not shaped."""

    axis: str
    kind: str
    frequency_hz: float
    damping_ratio: float

    def pulses(self) -> Pulses:
        """(weights, delays in s with mean 0); empty if not shaped."""
        if not self.frequency_hz:
            return [], []
        undamped = math.sqrt(1.0 - self.damping_ratio**2)
        weights, times = SHAPERS[self.kind](math.exp(-self.damping_ratio * math.pi / undamped))
        total = sum(weights)
        weights = [w / total for w in weights]
        period_s = 1.0 / (self.frequency_hz * undamped)
        mean = sum(w * t for w, t in zip(weights, times, strict=True))
        return weights, [(t - mean) * period_s for t in times]

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
            kind = gcmd.get(f"SHAPER_TYPE_{letter}", common or axis.kind).lower()
            if kind not in SHAPERS:
                raise gcmd.error(f"Unsupported shaper type '{kind}' (known: {', '.join(SHAPERS)})")
            frequency = or_zero(gcmd.get_float, f"SHAPER_FREQ_{letter}", axis.frequency_hz, SHAPER_HZ)
            damping = gcmd.get_float(f"DAMPING_RATIO_{letter}", axis.damping_ratio, **DAMPING_RATIO)
            changed.append(AxisShaper(axis.axis, kind, frequency, damping))
        if changed != self.axes:
            self._apply(changed)
            self.axes = changed
        for axis in self.axes:
            if axis.axis != "z" or axis.frequency_hz:
                gcmd.respond_info(axis.describe())


def _read_axis(config: ConfigWrapper, axis: str) -> AxisShaper:
    kinds = {name: name for name in SHAPERS}
    common = config.getchoice("shaper_type", kinds, DEFAULT_TYPE)
    return AxisShaper(
        axis,
        config.getchoice(f"shaper_type_{axis}", kinds, common),
        or_zero(config.getfloat, f"shaper_freq_{axis}", 0.0, SHAPER_HZ),
        config.getfloat(f"damping_ratio_{axis}", DEFAULT_DAMPING_RATIO, **DAMPING_RATIO),
    )


def load_config(config: ConfigWrapper) -> InputShaper:
    shaper = InputShaper(config.get_printer(), [_read_axis(config, axis) for axis in AXES])
    shaper.register()
    return shaper
