"""Following the nozzle's temperature through blocks: a Kalman filter in temperature that knows the heat going in.

State: T (degC) and q (K/s), the heating rate the model does not explain (melt, fan, a wrong mass or loss).

    dT/dt = (P(phase) - loss(T)) / C(T) + q + noise        dq/dt = noise
    measured = T + noise,  variance of one block's mean over its samples

Every block was converted with its own phase before it comes here; the drive's steps enter as known heat, so
they cost no
lag. A block without a believable temperature still moves the model on. One that disagrees by far is left out,
several of
them in a row restart the filter: the machine is right, not the model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from . import model
from .records import SampleBlock, TempEstimate


@dataclass(frozen=True, slots=True)
class TrackParameters:
    """What the filter assumes of the nozzle and how fast the unexplained rate may change."""

    loss: model.LossLaw
    heat: model.HeatCapacity = field(default_factory=model.HeatCapacity)
    # Spectral density of dq/dt, K^2/s^3: extrusion at 13 mm^3/s starts within 50 ms and takes 13 K/s; with
    # blocks of 1.6 ms and 1 LSB this makes the filter as quiet as 4^5 samples (17 bit) at 10 ms of memory.
    rate_noise: float = 1000.0
    temp_noise: float = 0.01  # K^2/s
    gap_s: float = 0.25  # without a measurement for longer: start anew
    gate_sigma: float = 8.0
    gate_c: float = 3.0
    outliers_max: int = 4


@dataclass(slots=True)
class TrackState:
    """Memory; `time_s` is NaN before the first measurement."""

    time_s: float = math.nan  # what T and q belong to
    end_s: float = math.nan  # end of the newest block: until then its power held
    power_w: float = 0.0
    measured_s: float = math.nan  # newest measurement that entered
    temp_c: float = math.nan
    rate_k_s: float = 0.0
    p_tt: float = 0.0  # covariance
    p_tq: float = 0.0
    p_qq: float = 0.0
    outliers: int = 0
    innovation_c: float = 0.0  # newest: measured minus predicted


RATE_START = 900.0  # (K/s)^2: variance of q at a start; 30 K/s


def _restart(state: TrackState, estimate: TempEstimate) -> None:
    state.temp_c = estimate.temp_c
    state.rate_k_s = 0.0
    state.p_tt = estimate.sigma_noise_c * estimate.sigma_noise_c
    state.p_tq = 0.0
    state.p_qq = RATE_START
    state.outliers = 0
    state.innovation_c = 0.0
    state.time_s = state.measured_s = estimate.time_s


def _predict(parameters: TrackParameters, state: TrackState, block: SampleBlock, power_w: float) -> None:
    """Move the state to the block's centre; the power before held until the end of the block before."""
    centre_s = block.time_s + 0.5 * block.duration_s
    dt_s = centre_s - state.time_s
    before_s = min(max(0.0, state.end_s - state.time_s), dt_s)
    mean_w = (state.power_w * before_s + power_w * (dt_s - before_s)) / dt_s if dt_s > 0.0 else power_w
    rise = (mean_w - model.loss_w(parameters.loss, state.temp_c)) / parameters.heat.at(state.temp_c)
    state.temp_c += (rise + state.rate_k_s) * dt_s
    state.p_tt += dt_s * (2.0 * state.p_tq + dt_s * state.p_qq + parameters.temp_noise)
    state.p_tq += dt_s * state.p_qq
    state.p_qq += dt_s * parameters.rate_noise
    state.time_s = centre_s


def track(
    parameters: TrackParameters,
    state: TrackState,
    block: SampleBlock,
    power_w: float,
    estimate: TempEstimate | None,
) -> TempEstimate | None:
    """One block in order of time, with the heat of its phase and its own estimate (None or invalid: nothing measured).

    The filtered estimate at the block's centre, or None when this block gave no believable one.
    """
    usable = estimate is not None and estimate.valid
    gap = not block.time_s + block.duration_s - state.measured_s <= parameters.gap_s
    if gap or block.time_s < state.time_s:
        state.measured_s = math.nan
        state.end_s, state.power_w = block.time_s + block.duration_s, power_w
        if estimate is None or not usable:
            return None
        _restart(state, estimate)
        return estimate
    _predict(parameters, state, block, power_w)
    state.end_s, state.power_w = block.time_s + block.duration_s, power_w
    if estimate is None or not usable:
        return None
    noise = estimate.sigma_noise_c * estimate.sigma_noise_c
    spread = state.p_tt + noise
    innovation_c = estimate.temp_c - state.temp_c
    state.innovation_c = innovation_c
    if abs(innovation_c) > parameters.gate_sigma * math.sqrt(spread) + parameters.gate_c:
        state.outliers += 1
        if state.outliers < parameters.outliers_max:
            return None
        _restart(state, estimate)
        return estimate
    state.outliers = 0
    gain_t, gain_q = state.p_tt / spread, state.p_tq / spread
    state.temp_c += gain_t * innovation_c
    state.rate_k_s += gain_q * innovation_c
    state.p_qq -= gain_q * state.p_tq
    state.p_tq -= gain_t * state.p_tq
    state.p_tt -= gain_t * state.p_tt
    state.measured_s = state.time_s
    law_variance = estimate.sigma_c * estimate.sigma_c - noise
    return TempEstimate(
        state.time_s,
        state.temp_c,
        math.sqrt(max(0.0, law_variance) + state.p_tt),
        math.sqrt(state.p_tt),
        estimate.dtemp_derror,
        estimate.phase_ticks,
        True,
        "",
    )
