"""Temperature Kalman filter, the input of PID, watermark and two-period control; the heat that goes in is known.

Supervision and status use it with every law; predictive control has its own filter (control/predictive_filter.py).

State: T (degC) and q (K/s), the heating rate the model does not explain (melt, fan, a wrong mass or loss).

    dT/dt = (P(phase) - loss(T)) / C(T) + q + noise        dq/dt = noise
    measured = T + noise,  variance of one block's mean over its samples

Every block was converted with its own phase before it comes here; the drive's steps enter as known heat, so they cost
no lag. A block without a valid temperature still moves the model on. One that disagrees by far is left out,
several of them in a row restart the filter: the machine is right, not the model.

The filter is thermal/sensing/temperature_filter.c; here are its parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from thermal.models import heat_loss


@dataclass(frozen=True, slots=True)
class FilterParameters:
    """What the filter assumes of the nozzle and how fast the unexplained rate may change."""

    loss: heat_loss.LossLaw
    heat: heat_loss.HeatCapacity = field(default_factory=heat_loss.HeatCapacity)
    # Spectral density of dq/dt, K^2/s^3: extrusion at 13 mm^3/s starts within 50 ms and takes 13 K/s; with
    # blocks of 1.6 ms and 1 LSB this makes the filter as quiet as 4^5 samples (17 bit) at 10 ms of memory.
    rate_noise: float = 1000.0
    temp_noise: float = 0.01  # K^2/s
    gap_s: float = 0.25  # without a measurement for longer: start anew
    gate_sigma: float = 8.0
    gate_c: float = 3.0
    outliers_max: int = 4


def filter_params(parameters: FilterParameters) -> dict[str, float]:
    """As C's struct filter_params: the heat capacity is a straight line over T."""
    loss, heat = parameters.loss, parameters.heat
    return {
        "conductance_w_k": loss.conductance_w_k,
        "radiation_m2": loss.radiation_m2,
        "ambient_c": loss.ambient_c,
        "capacity_j_k": heat.at(0.0),
        "capacity_slope_j_k2": heat.at_25c_j_k * heat.slope_per_k,
        "rate_noise": parameters.rate_noise,
        "temp_noise": parameters.temp_noise,
        "gap_s": parameters.gap_s,
        "gate_sigma": parameters.gate_sigma,
        "gate_c": parameters.gate_c,
        "outliers_max": parameters.outliers_max,
    }
