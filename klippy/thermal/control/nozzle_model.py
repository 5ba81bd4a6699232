"""Parameters of the predictive law for an induction nozzle, from what the rest of the chain knows of it.

Heat capacity and the paths of heat come from the calibration (or are those of the reference nozzle), melt and fan
from their options; nothing here is tuned twice.
"""

from __future__ import annotations

from thermal.models.heat_loss import HeatCapacity
from thermal.models.heater_model import ModelParameters
from thermal.models.melt_exchange import MeltExchange
from thermal.sensing.heat_balance_monitor import TwoNodeLoss

from .timeline import Timing

TAU_S = 0.045  # five control intervals: noise of the estimate is not chased
FAN_W_K = 5e-3
FLOW_LAG_S = 0.020  # compliance between motor and nozzle
# Plan this far ahead. The output of a step holds from 15 to 23 ms after it; the next step is up to 25 ms later, 50 if
# the host is late, and holds 23 ms after that: until then, 90 ms after the first, the MCU goes by the plan.
AHEAD_S = 0.090
# Process noise of the disturbance power (W per sqrt(s)) and of the nodes (degC per sqrt(s)), density of coloured
# errors of the reading. Together they set the bandwidth of the estimate: 20 rad/s on the reference nozzle, well damped.
DISTURBANCE_W = 1.4
TEMP_WALK_C = 0.36
COLOURED_C2_S = 5e-5
SLANT_C = 1.0  # what full drive by itself may add to the reading (degC)
# An uncalibrated law is off by another amount at each drive. Its filter takes errors as white and follows a bias of the
# innovations.
UNCALIBRATED_DISTURBANCE_W = 0.3
DISTURBANCE_W2_PER_K = 0.012  # 1.6 W over a climb to 250 degC: losses wrong by 30 % are learned on the way
DISTURBANCE_MAX_W = 20.0  # melt at any flow, a draught, losses wrong by half: 15 W


def nozzle_model(
    heat: HeatCapacity,
    loss: TwoNodeLoss,
    power_max_w: float,
    timing: Timing,
    melt: MeltExchange | None = None,
    fan_w_k: float = FAN_W_K,
    calibrated: bool = True,
) -> ModelParameters:
    """Output in watts. Raises ParameterError where no nozzle can be so."""
    melt = melt or MeltExchange()
    stride_s = timing.stride_s
    return ModelParameters(
        heat_j_k=heat.at_25c_j_k,
        heat_slope_per_k=heat.slope_per_k,
        loss_w_k=loss.skin_w_k,
        radiation_m2=loss.radiation_m2,
        ambient_c=loss.ambient_c,
        second_j_k=loss.second_j_k,
        link_w_k=loss.link_w_k,
        second_loss_w_k=loss.second_w_k,
        output_w=1.0,
        output_high=power_max_w,
        fan_w_k=fan_w_k,
        melt_ua_w_k=melt.ua_w_k,
        melt_j_mm3_k=1e-3 * melt.heat_mj_m3k,
        melt_in_c=melt.inlet_c,
        bore_s=melt.bore_lag_s,
        flow_s=FLOW_LAG_S,
        hold_s=stride_s,
        tau_s=TAU_S,
        delay_s=timing.lead_s,
        ahead=round(AHEAD_S / stride_s),
        disturbance_w=DISTURBANCE_W if calibrated else UNCALIBRATED_DISTURBANCE_W,
        disturbance_w2_per_k=DISTURBANCE_W2_PER_K,
        disturbance_max_w=DISTURBANCE_MAX_W,
        slant_c=SLANT_C,
        temp_walk_c=TEMP_WALK_C if calibrated else 0.02,
        coloured_c2_s=COLOURED_C2_S if calibrated else 0.0,
    )
