"""Plant of predictive control written out in Python, as an independent reference for the one in C.

Straight from the equations in the docstring of heater_model. Parameters are klippy's own.
"""

from __future__ import annotations

import math
from bisect import bisect_right

from thermal.control.control_api import Reference, Schedule
from thermal.models.heat_loss import STEFAN_BOLTZMANN, ZERO_CELSIUS_K
from thermal.models.heater_model import ModelParameters, Nodes

# Quantities over time


def schedule_at(schedule: Schedule, time_s: float) -> float:
    after = bisect_right(schedule.times_s, time_s)
    return schedule.values[after - 1] if after else schedule.before


def changes(schedule: Schedule, start_s: float, end_s: float) -> bool:
    """Whether another value begins within start_s < t <= end_s."""
    return bisect_right(schedule.times_s, start_s) != bisect_right(schedule.times_s, end_s)


def reference_at(reference: Reference, time_s: float) -> float:
    after = bisect_right(reference.times_s, time_s)
    if after == 0:
        return reference.temps_c[0]
    if after == len(reference.times_s):
        return reference.temps_c[-1]
    start_s, start_c = reference.times_s[after - 1], reference.temps_c[after - 1]
    share = (time_s - start_s) / (reference.times_s[after] - start_s)
    return start_c + share * (reference.temps_c[after] - start_c)


def is_flat(reference: Reference, start_s: float, end_s: float) -> bool:
    """Whether one temperature is wanted all through start_s <= t <= end_s."""
    after = bisect_right(reference.times_s, start_s)
    ahead = reference.temps_c[after : bisect_right(reference.times_s, end_s) + 1]
    return all(temp_c == reference_at(reference, start_s) for temp_c in ahead)


# The plant


def at_rest(p: ModelParameters, temp_c: float) -> Nodes:
    """All nodes as they are when the controlled one has been held at this temperature for long."""
    share = p.link_w_k / (p.link_w_k + p.second_loss_w_k) if p.second_j_k else 0.0
    second_c = p.ambient_c + share * (temp_c - p.ambient_c)
    element_c = temp_c
    if p.element_j_k:
        element_c += max(0.0, hold_w(p, temp_c, 0.0, 0.0)) / p.element_w_k
    return Nodes(element_c, temp_c, second_c, temp_c, temp_c, 0.0)


def melt_w_k(p: ModelParameters, flow_mm3_s: float) -> float:
    """Heat the melt takes per kelvin of bore above inlet."""
    capacity_w_k = p.melt_j_mm3_k * flow_mm3_s
    if capacity_w_k <= 1e-9 or not p.melt_ua_w_k:
        return 0.0
    return capacity_w_k * -math.expm1(-p.melt_ua_w_k / capacity_w_k)


def hold_w(p: ModelParameters, temp_c: float, flow_mm3_s: float, fan: float) -> float:
    """Heat that holds the controlled node at this temperature in the long run."""
    rise_k = temp_c - p.ambient_c
    through = p.link_w_k * p.second_loss_w_k / (p.link_w_k + p.second_loss_w_k) if p.second_j_k else 0.0
    hot_k, cold_k = temp_c + ZERO_CELSIUS_K, p.ambient_c + ZERO_CELSIUS_K
    radiated = STEFAN_BOLTZMANN * p.radiation_m2 * (hot_k**4 - cold_k**4)
    melt = melt_w_k(p, flow_mm3_s) * (temp_c - p.melt_in_c)
    return (p.loss_w_k + fan * p.fan_w_k + through) * rise_k + radiated + melt


def capacity_j_k(p: ModelParameters, temp_c: float) -> float:
    return p.heat_j_k * (1.0 + p.heat_slope_per_k * (temp_c - 25.0))


def heat_per_output_w(p: ModelParameters, temp_c: float) -> float:
    """Heat of one unit of output at this temperature, drive gain 1."""
    return p.output_w * (1.0 + p.output_slope_per_k * (temp_c - 25.0))


def advance(
    p: ModelParameters,
    nodes: Nodes,
    drive: tuple[float, float, float],
    surroundings: tuple[float, float],
    dt_s: float,
) -> Nodes:
    """The nodes `dt_s` later. drive = (output, gain, disturbance_w); surroundings = (flow mm^3/s, fan 0..1)."""
    if dt_s <= 0.0:
        return nodes
    steps = 1 if dt_s <= p.step_s else math.ceil(dt_s / p.step_s)
    output, gain, disturbance_w = drive
    flow_in, fan = surroundings
    element_c, temp_c, second_c, sensor_c, bore_c, flow = nodes
    h = dt_s / steps
    air_w_k = p.loss_w_k + fan * p.fan_w_k
    ambient_c, cold_k4, radiation = p.ambient_c, p.air_k4, STEFAN_BOLTZMANN * p.radiation_m2
    bore_decay = math.exp(-h / p.bore_s) if p.bore_s else 0.0
    sensor_decay = math.exp(-h / p.sensor_s) if p.sensor_s else 0.0
    for _ in range(steps):
        if flow != flow_in:
            flow = flow_in + (flow - flow_in) * (math.exp(-h / p.flow_s) if p.flow_s else 0.0)
        heat = gain * output * p.output_w * (1.0 + p.output_slope_per_k * (temp_c - 25.0))
        if p.element_j_k:
            passed = p.element_w_k * (element_c - temp_c)
            element_c += h * (heat - passed) / p.element_j_k
            heat = passed
        link = p.link_w_k * (temp_c - second_c)
        hot_k = temp_c + ZERO_CELSIUS_K
        net = heat + disturbance_w - link - air_w_k * (temp_c - ambient_c)
        net -= radiation * (hot_k * hot_k * hot_k * hot_k - cold_k4)
        if flow > 1e-9:
            net -= melt_w_k(p, flow) * (bore_c - p.melt_in_c)
        if p.second_j_k:
            second_c += h * (link - p.second_loss_w_k * (second_c - ambient_c)) / p.second_j_k
        before_c = temp_c
        temp_c += h * net / (p.heat_j_k * (1.0 + p.heat_slope_per_k * (temp_c - 25.0)))
        middle_c = 0.5 * (before_c + temp_c)
        sensor_c = middle_c + (sensor_c - middle_c) * sensor_decay if p.sensor_s else temp_c
        bore_c = middle_c + (bore_c - middle_c) * bore_decay if p.bore_s else temp_c
    return Nodes(element_c, temp_c, second_c, sensor_c, bore_c, flow)
