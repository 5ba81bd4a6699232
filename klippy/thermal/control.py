"""Controllers behind one verb: `step(parameters, state, input, time) -> output`.

Parameters are frozen, state is a plain record the caller keeps, input and output are frozen: a controller can
be replayed from a log. PID serves both worlds, its output unit being what its gains say: watts for the
induction nozzle, duty 0..1 for ordinary heaters (`klipper_pid` scales the documented Kp Ki Kd, which are per
255).

    output = feedforward + Kp e + integral(Ki e) - Kd dT/dt,     e = reference - measured

Derivative on the measurement (a target step gives no kick), low-pass filtered with `derivative_s`. Anti-
windup: the integral is held while the limited output cannot follow and the error would push it further, and
is itself limited to the output range. `track` re-bases the integral on an output somebody else has set:
bumpless transfer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, TypeVar

PID_SCALE = 255.0  # Klipper's documented scale of pid_Kp pid_Ki pid_Kd

P_contra = TypeVar("P_contra", contravariant=True)
S_contra = TypeVar("S_contra", contravariant=True)


@dataclass(frozen=True, slots=True)
class ControlInput:
    """What every controller sees."""

    reference_c: float
    measured_c: float
    feedforward: float = 0.0  # in output units
    limit: float = math.inf  # output limit of this step, on top of the parameters' own
    rebased: bool = False  # the measurement jumped for reasons of its own: not a slope


@dataclass(frozen=True, slots=True)
class ControlOutput:
    """The limited output and its terms, all in output units."""

    value: float
    unlimited: float
    proportional: float
    integral: float
    derivative: float
    feedforward: float


class Controller(Protocol[P_contra, S_contra]):
    """The role all control laws play; `time_s` is the time of the measurement."""

    def __call__(
        self, parameters: P_contra, state: S_contra, inputs: ControlInput, time_s: float
    ) -> ControlOutput: ...


@dataclass(frozen=True, slots=True)
class PidParameters:
    """Gains in output units per K, per K s, and per K/s."""

    kp: float
    ki: float
    kd: float
    output_low: float
    output_high: float
    derivative_s: float  # time constant of the derivative's filter
    gap_s: float = 1.0  # a longer pause between measurements restarts the derivative and is not integrated


@dataclass(slots=True)
class PidState:
    """Memory of a PID between steps."""

    time_s: float = -math.inf
    measured_c: float = math.nan
    slope_c_s: float = 0.0  # filtered dT/dt
    integral: float = 0.0  # output units


def pid_step(
    parameters: PidParameters, state: PidState, inputs: ControlInput, time_s: float
) -> ControlOutput:
    """One PID update with a new measurement taken at `time_s`."""
    dt_s = time_s - state.time_s
    fresh = not 0.0 < dt_s <= parameters.gap_s
    if fresh:
        state.slope_c_s = 0.0
        dt_s = 0.0
    elif not inputs.rebased:
        raw_slope = (inputs.measured_c - state.measured_c) / dt_s
        state.slope_c_s += (raw_slope - state.slope_c_s) * dt_s / (dt_s + parameters.derivative_s)
    state.time_s = time_s
    state.measured_c = inputs.measured_c
    error_c = inputs.reference_c - inputs.measured_c
    proportional = parameters.kp * error_c
    derivative = -parameters.kd * state.slope_c_s
    base = inputs.feedforward + proportional + derivative
    step = parameters.ki * error_c * dt_s
    wanted = base + state.integral + step
    high = min(parameters.output_high, inputs.limit)
    stuck_high = wanted > high and step > 0.0
    stuck_low = wanted < parameters.output_low and step < 0.0
    if not (stuck_high or stuck_low):
        span = parameters.output_high - parameters.output_low
        state.integral = min(span, max(-span, state.integral + step))
    unlimited = base + state.integral
    value = min(high, max(parameters.output_low, unlimited))
    return ControlOutput(value, unlimited, proportional, state.integral, derivative, inputs.feedforward)


def pid_track(parameters: PidParameters, state: PidState, inputs: ControlInput, output: float) -> None:
    """Re-base the integral so that the next step continues from `output` (bumpless transfer)."""
    held = inputs.feedforward + parameters.kp * (inputs.reference_c - inputs.measured_c)
    held -= parameters.kd * state.slope_c_s
    span = parameters.output_high - parameters.output_low
    state.integral = min(span, max(-span, output - held))


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


@dataclass(slots=True)
class WatermarkState:
    """Whether the heater is on."""

    heating: bool = False


def watermark_step(
    parameters: WatermarkParameters, state: WatermarkState, inputs: ControlInput, time_s: float
) -> ControlOutput:
    """One on-off decision; `time_s` does not matter to this law."""
    error_c = inputs.reference_c - inputs.measured_c
    if error_c >= parameters.max_delta_c:
        state.heating = True
    elif error_c <= -parameters.max_delta_c:
        state.heating = False
    value = parameters.output_high if state.heating else 0.0
    return ControlOutput(value, value, value, 0.0, 0.0, 0.0)
