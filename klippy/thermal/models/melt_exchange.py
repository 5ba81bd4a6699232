"""What the melt takes from the nozzle and how hot it leaves, and how fast the nozzle can follow a plan.

A thermal node and its holder: C(T) dT/dt = P - loss(T) - melt(T, flow), with the holder in balance, gives 10.1 K/s
idle at 250 degC, against the 10-14 K/s of the real nozzle. In a fall the holder stays behind and
warms it, in a rise it takes heat: with h the nozzle temperature at which the holder would be in balance,

    extra loss = link^2/(link + second) (T - h)        dh/dt = (T - h) (link + second)/C_second
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from .heat_loss import HeatCapacity, LossLaw, loss_w

WAY_STEP_C = 2.0
MIN_K_S = 0.5  # near the surroundings nothing cools any more; by then no plan is waited for


@dataclass(frozen=True, slots=True)
class MeltExchange:
    """Heat exchange between bore and melt (reference plant: UA = 27.6 mW/K, rho c = 2.1 MJ/m3K)."""

    ua_w_k: float = 0.0276
    heat_mj_m3k: float = 2.1
    inlet_c: float = 25.0
    bore_lag_s: float = 0.049  # 0.8 mm wall
    volume_mm3: float = 0.0  # melt between bore wall and orifice; 0: none known
    tip_k_w: float = 3.1  # coil zone to tip, by the heat into the melt: 11 K at 3.5 W over 2 mm of steel

    def share(self, flow_mm3_s: float) -> float:
        """Part of the way from inlet to wall temperature that the melt goes, 0..1."""
        capacity_w_k = 1e-3 * self.heat_mj_m3k * flow_mm3_s
        return 1.0 if capacity_w_k <= 1e-9 else -math.expm1(-self.ua_w_k / capacity_w_k)

    def heat_w_k(self, flow_mm3_s: float) -> float:
        """Heat the melt takes per kelvin of wall above inlet; never more than UA."""
        return 1e-3 * self.heat_mj_m3k * flow_mm3_s * self.share(flow_mm3_s) if flow_mm3_s > 0.0 else 0.0

    def tip_c(self, temp_c: float, flow_mm3_s: float) -> float:
        """The steel where the melt leaves it, at a steady flow."""
        return temp_c - self.tip_k_w * self.heat_w_k(flow_mm3_s) * (temp_c - self.inlet_c)

    def lag_s(self, flow_mm3_s: float) -> float:
        """Time from a change of the nozzle to the change of the melt that leaves it.

        The residence V/flow counts only until the melt has taken on the wall's new temperature, V rho c/UA.
        """
        if self.volume_mm3 <= 0.0:
            return self.bore_lag_s
        adapted_s = 1e-3 * self.heat_mj_m3k * self.volume_mm3 / self.ua_w_k
        return self.bore_lag_s + min(adapted_s, self.volume_mm3 / max(flow_mm3_s, 1e-9))


@dataclass(frozen=True, slots=True)
class NozzleLimits:
    """What bounds the plan. `power_w`: heat into the metal that planning may use."""

    min_c: float = 0.0
    max_c: float = 300.0
    min_extrude_c: float = 170.0
    power_w: float = 65.0  # 80 % of the reference plant's 81 W: the rest is the controller's
    holder_w_k: float = 0.0296  # reference plant: 41.1^2/(41.1 + 16.0) mW/K
    holder_s: float = 10.0  # 0.572 J/K/(41.1 + 16.0) mW/K
    loss: LossLaw = field(default_factory=LossLaw)
    capacity: HeatCapacity = field(default_factory=HeatCapacity)
    exchange: MeltExchange = field(default_factory=MeltExchange)


def hold_w(limits: NozzleLimits, temp_c: float, flow_mm3_s: float) -> float:
    """Power that holds a temperature at a flow."""
    exchange = limits.exchange
    return loss_w(limits.loss, temp_c) + exchange.heat_w_k(flow_mm3_s) * max(0.0, temp_c - exchange.inlet_c)


def heating_k_s(limits: NozzleLimits, temp_c: float, flow_mm3_s: float) -> float:
    """Fastest rise at full planned power; negative where the power cannot hold the temperature."""
    return (limits.power_w - hold_w(limits, temp_c, flow_mm3_s)) / limits.capacity.at(temp_c)


def cooling_k_s(limits: NozzleLimits, temp_c: float, flow_mm3_s: float) -> float:
    """Fastest fall with the power off and the holder in balance, a positive number."""
    return hold_w(limits, temp_c, flow_mm3_s) / limits.capacity.at(temp_c)


def idle_way(
    limits: NozzleLimits, start_s: float, start_c: float, holder_c: float, end_c: float
) -> list[tuple[float, float]]:
    """Corners (s, degC) of the quickest way from one temperature to another without flow.

    `holder_c`: nozzle temperature at which the holder is in balance at the start. Rates are those of the slower end
    of each step.
    """
    now_s, now_c = start_s, start_c
    corners = [(now_s, now_c)]
    while now_c != end_c:
        next_c = min(end_c, now_c + WAY_STEP_C) if end_c > now_c else max(end_c, now_c - WAY_STEP_C)
        held_k_s = limits.holder_w_k * (next_c - holder_c) / limits.capacity.at(next_c)
        up, down = heating_k_s(limits, next_c, 0.0) - held_k_s, cooling_k_s(limits, next_c, 0.0) + held_k_s
        step_s = abs(next_c - now_c) / max(MIN_K_S, up if end_c > now_c else down)
        holder_c += (next_c - holder_c) * -math.expm1(-step_s / limits.holder_s)
        now_s, now_c = now_s + step_s, next_c
        corners.append((now_s, now_c))
    return corners


def highest_c(limits: NozzleLimits) -> float:
    """Highest temperature within `max_c` that the power holds at any flow (the melt takes UA at most)."""
    low, high = limits.loss.ambient_c, limits.max_c
    ua_w_k, inlet_c = limits.exchange.ua_w_k, limits.exchange.inlet_c

    def spare_w(temp_c: float) -> float:
        return limits.power_w - loss_w(limits.loss, temp_c) - ua_w_k * max(0.0, temp_c - inlet_c)

    if spare_w(high) > 0.0:
        return high
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if spare_w(middle) > 0.0 else (low, middle)
    return low
