"""PID and watermark as laws of control_api: `step(parameters, state, input, time) -> output, state`.

PID serves both worlds, its output unit being what its gains say: watts for the induction nozzle, duty 0..1
for ordinary heaters (`klipper_pid` scales the documented Kp Ki Kd, which are per 255).

    output = feedforward + Kp e + integral(Ki e) - Kd dT/dt,     e = reference - measured

Derivative on the measurement (a target step gives no kick), low-pass filtered with `derivative_s`. Anti-
windup: the integral is held while the limited output cannot follow and the error would push it further, and
is itself limited to the output range. `pid_follow` re-bases the integral on an output somebody else has set:
bumpless transfer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from thermal.records import ParameterError, require

from .control_api import ControlInput, ControlOutput, Law

__all__ = [
    "PID",
    "WATERMARK",
    "ControlInput",
    "ControlOutput",
    "ParameterError",
    "PidParameters",
    "PidState",
    "WatermarkParameters",
    "WatermarkState",
    "klipper_pid",
    "pid_follow",
    "pid_step",
    "watermark_follow",
    "watermark_step",
]

PID_SCALE = 255.0  # Klipper's documented scale of pid_Kp pid_Ki pid_Kd


@dataclass(frozen=True, slots=True)
class PidParameters:
    """Gains in output units per K, per K s, and per K/s. Raises ParameterError on impossible ones."""

    kp: float
    ki: float
    kd: float
    output_low: float
    output_high: float
    derivative_s: float  # time constant of the derivative's filter
    gap_s: float = 1.0  # a longer pause between measurements restarts the derivative and is not integrated

    def __post_init__(self) -> None:
        require(0.0 < self.kp < math.inf, f"PID: Kp must be above 0, not {self.kp:g}")
        require(0.0 <= self.ki < math.inf, f"PID: Ki must not be negative, it is {self.ki:g}")
        require(0.0 <= self.kd < math.inf, f"PID: Kd must not be negative, it is {self.kd:g}")
        require(0.0 <= self.derivative_s < math.inf, "PID: the derivative's time must not be negative")
        require(
            -math.inf < self.output_low < self.output_high < math.inf,
            f"PID: the output has no room between {self.output_low:g} and {self.output_high:g}",
        )


@dataclass(frozen=True, slots=True)
class PidState:
    """Memory of a PID between steps."""

    time_s: float = -math.inf
    measured_c: float = math.nan
    slope_c_s: float = 0.0  # filtered dT/dt
    integral: float = 0.0  # output units


def _slope(parameters: PidParameters, state: PidState, inputs: ControlInput, dt_s: float) -> float:
    """Filtered dT/dt after this measurement; a restart (dt 0) forgets the one before."""
    if dt_s <= 0.0:
        return 0.0
    if inputs.rebased:
        return state.slope_c_s
    raw = (inputs.measured_c - state.measured_c) / dt_s
    return state.slope_c_s + (raw - state.slope_c_s) * dt_s / (dt_s + parameters.derivative_s)


def _bounded(parameters: PidParameters, integral: float) -> float:
    span = parameters.output_high - parameters.output_low
    return min(span, max(-span, integral))


def pid_step(
    parameters: PidParameters, state: PidState, inputs: ControlInput, time_s: float
) -> tuple[ControlOutput, PidState]:
    """One PID update with a new measurement taken at `time_s`."""
    dt_s = time_s - state.time_s
    if not 0.0 < dt_s <= parameters.gap_s:
        dt_s = 0.0
    slope_c_s = _slope(parameters, state, inputs, dt_s)
    error_c = inputs.reference_c - inputs.measured_c
    proportional = parameters.kp * error_c
    derivative = -parameters.kd * slope_c_s
    base = inputs.feedforward + proportional + derivative
    step = parameters.ki * error_c * dt_s
    wanted = base + state.integral + step
    high = min(parameters.output_high, inputs.limit)
    stuck_high = wanted > high and step > 0.0
    stuck_low = wanted < parameters.output_low and step < 0.0
    integral = state.integral
    if not (stuck_high or stuck_low):
        integral = _bounded(parameters, integral + step)
    unlimited = base + integral
    value = min(high, max(parameters.output_low, unlimited))
    output = ControlOutput(value, unlimited, proportional, integral, derivative, inputs.feedforward)
    return output, PidState(time_s, inputs.measured_c, slope_c_s, integral)


def pid_follow(parameters: PidParameters, state: PidState, inputs: ControlInput, output: float) -> PidState:
    """Re-base the integral so that the next step continues from `output` (bumpless transfer)."""
    held = inputs.feedforward + parameters.kp * (inputs.reference_c - inputs.measured_c)
    held -= parameters.kd * state.slope_c_s
    return replace(state, integral=_bounded(parameters, output - held))


PID: Law[PidParameters, PidState] = Law("pid", pid_step, PidState(), pid_follow)


def klipper_pid(
    pid_kp: float, pid_ki: float, pid_kd: float, max_power: float, smooth_time_s: float
) -> PidParameters:
    """PID of an ordinary heater: output is PWM duty 0..max_power, gains as documented for printer.cfg."""
    return PidParameters(
        pid_kp / PID_SCALE,
        pid_ki / PID_SCALE,
        pid_kd / PID_SCALE,
        0.0,
        max_power,
        smooth_time_s,
        gap_s=5.0,
    )


@dataclass(frozen=True, slots=True)
class WatermarkParameters:
    """On-off control: `max_delta_c` below the target the heater turns on, as much above it turns off."""

    max_delta_c: float
    output_high: float

    def __post_init__(self) -> None:
        require(0.0 < self.max_delta_c < math.inf, "watermark: max_delta must be above 0")
        require(0.0 < self.output_high < math.inf, "watermark: the output must be above 0")


@dataclass(frozen=True, slots=True)
class WatermarkState:
    """Whether the heater is on."""

    heating: bool = False


def watermark_step(
    parameters: WatermarkParameters, state: WatermarkState, inputs: ControlInput, time_s: float
) -> tuple[ControlOutput, WatermarkState]:
    """One on-off decision; `time_s` does not matter to this law."""
    error_c = inputs.reference_c - inputs.measured_c
    heating = state.heating
    if error_c >= parameters.max_delta_c:
        heating = True
    elif error_c <= -parameters.max_delta_c:
        heating = False
    value = min(parameters.output_high, inputs.limit) if heating else 0.0
    return ControlOutput(value, value, value, 0.0, 0.0, 0.0), WatermarkState(heating)


def watermark_follow(
    parameters: WatermarkParameters, state: WatermarkState, inputs: ControlInput, output: float
) -> WatermarkState:
    """Goes on as it is: on or off."""
    return WatermarkState(output > 0.0)


WATERMARK: Law[WatermarkParameters, WatermarkState] = Law(
    "watermark", watermark_step, WatermarkState(), watermark_follow
)
