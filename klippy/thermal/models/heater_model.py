"""The model a `model` controller holds of its heater: up to six nodes, integrated with plain steps.

    output ─► [element] ─► controlled node ─► air, radiation, fan
                              │   │   └► [sensor lag] ─► measured
                              │   └► bore ─► melt (planned flow)
                              └► [second mass] ─► air

    Ce dE/dt  = g u W s(T) - ke (E - T)                                       element, 0 J/K: heats T directly
    C(T) dT/dt = heat - k2 (T - T2) - (g0 + fan gf)(T - Ta) - sigma eA (T^4 - Ta^4) - h(flow)(B - Tin) + d
    C2 dT2/dt = k2 (T - T2) - g2 (T2 - Ta)                                    second mass, 0 J/K: none
    tau dS/dt = T - S,   tau_b dB/dt = T - B,   tau_f df/dt = flow - f        sensor, bore, flow: exact exponentials
    h(f) = c f (1 - exp(-UA/(c f)))                                           heat of the melt, W/K

g (drive gain, about 1) and d (disturbance, W) are what the filter learns. Forms follow the thermal balance of
Oskolkov 2021's nozzle and of an ordinary cartridge hotend; the figures are the heater's own, from its config.

The arithmetic is thermal/models/heater_model.c; here are its parameters and their limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, NamedTuple

import chelper
from thermal.records import require

from .heat_loss import ZERO_CELSIUS_K

STEPS_PER_LAG = 10.0  # an Euler step is this much shorter than the fastest lag: 5 % of that lag in error
LONGEST_STEP_S = 0.25
STEPS_PER_HOLD = 30.0  # more steps of integration between two outputs take longer than the time they describe
CLIMB_MIN_K_S, CLIMB_MAX_K_S = 1e-3, 1e5  # at full power; a chamber makes 0.02, a light nozzle 1000
RISE_MIN_K = 2.0  # full power holds a heater at least this far above the room


@dataclass(frozen=True, slots=True)
class ModelParameters:
    """One heater. Raises ParameterError where no heater can be so. 0 leaves a node out."""

    heat_j_k: float  # controlled node, at 25 degC
    loss_w_k: float  # controlled node to air
    output_w: float  # heat per unit of output: 1.0 if the output is watts, the heater's power if it is duty
    output_high: float
    heat_slope_per_k: float = 0.0  # relative rise of heat_j_k
    radiation_m2: float = 0.0  # emissivity times area
    ambient_c: float = 25.0
    second_j_k: float = 0.0
    link_w_k: float = 0.0
    second_loss_w_k: float = 0.0
    element_j_k: float = 0.0
    element_w_k: float = 0.0
    sensor_s: float = 0.0
    output_slope_per_k: float = 0.0  # relative change of the heat per output around 25 degC (efficiency)
    fan_w_k: float = 0.0  # at full speed
    melt_ua_w_k: float = 0.0
    melt_j_mm3_k: float = 2.1e-3
    melt_in_c: float = 25.0
    bore_s: float = 0.0
    flow_s: float = 0.0
    # Control: what is wanted
    hold_s: float = 0.3  # time for which an output stays
    horizon_s: float = 0.0  # time until the wanted temperature is met; at least hold_s
    tau_s: float = 0.0  # closed-loop time constant: a small deviation decays with it
    band_c: float = 1.5  # proportional band; larger deviations fall to it as fast as the power allows
    slew_per_s: float = math.inf  # largest change of the output in a second
    delay_s: float = 0.0  # measurement to output in force, where the caller does not say
    ahead: int = 0  # further outputs planned beyond the first
    # Filter: what is uncertain, 1 sigma
    sigma_c: float = 0.05  # a measurement
    disturbance_w: float = 2.0  # change of the disturbance within a second, random walk
    disturbance_w2_per_k: float = (
        0.0  # its variance grows by this with the temperature: losses not quite known
    )
    disturbance_start_w: float = 2.0
    disturbance_max_w: float = math.inf
    gain_start: float = 0.3  # relative, of the drive's gain
    gain_walk: float = 0.005  # relative, within a second
    slant_c: float = 0.0  # of what full drive by itself moves the reading, degC; 0: nothing
    second_start: float = 0.2  # of the second mass's excess over air, relative
    temp_walk_c: float = 0.02  # of each node, within a second
    coloured_c2_s: float = 0.0  # spectral density of coloured errors of the reading; 0: white noise alone
    gap_s: float = 5.0  # after this time without readings: begin anew
    step_s: float = field(init=False, default=LONGEST_STEP_S)  # of the integration
    prediction_s: float = field(init=False, default=0.0)  # the prediction horizon H ...
    remaining: float = field(init=False, default=0.0)  # ... and the share of a small deviation left by then
    air_k4: float = field(init=False, default=0.0)  # fourth power of the air's absolute temperature
    _packed: Any = field(init=False, default=None, repr=False, compare=False)  # see packed()

    def __post_init__(self) -> None:
        self._check()
        lags = [self.sensor_s]
        if self.element_j_k:
            lags.append(self.element_j_k / self.element_w_k)
        lags.append(self.heat_j_k / (self.element_w_k + self.link_w_k + self.loss_w_k + 1e-12))
        if self.second_j_k:
            lags.append(self.second_j_k / (self.link_w_k + self.second_loss_w_k))
        shortest = min((lag for lag in lags if lag > 0.0), default=math.inf)
        object.__setattr__(self, "air_k4", (self.ambient_c + ZERO_CELSIUS_K) ** 4)
        span_s = max(self.hold_s, self.horizon_s)
        object.__setattr__(self, "prediction_s", span_s)
        object.__setattr__(self, "remaining", math.exp(-span_s / self.tau_s) if self.tau_s > 0.0 else 0.0)
        step_s = min(LONGEST_STEP_S, shortest / STEPS_PER_LAG)
        require(
            step_s * STEPS_PER_HOLD >= self.hold_s,
            f"model: a lag of {shortest:.2g} s cannot be followed; a heat capacity or a lag is much too small, or a"
            " loss or link much too large",
        )
        object.__setattr__(self, "step_s", step_s)

    def _check(self) -> None:
        for name in ("heat_j_k", "output_w", "output_high", "hold_s", "sigma_c", "gap_s"):
            value = getattr(self, name)
            require(0.0 < value < math.inf, f"model: {name} must be above 0, it is {value:g}")
        for name in (
            *("loss_w_k", "radiation_m2", "second_j_k", "link_w_k", "second_loss_w_k", "element_j_k"),
            *("element_w_k", "sensor_s", "fan_w_k", "melt_ua_w_k", "melt_j_mm3_k", "bore_s", "flow_s"),
            *("horizon_s", "tau_s", "band_c", "delay_s", "ahead", "disturbance_w", "disturbance_start_w"),
            "disturbance_w2_per_k",
            *("gain_start", "gain_walk", "slant_c", "second_start", "temp_walk_c", "coloured_c2_s"),
        ):
            value = getattr(self, name)
            require(0.0 <= value < math.inf, f"model: {name} must not be negative, it is {value:g}")
        require(self.slew_per_s > 0.0, "model: slew_per_s must be above 0")
        require(
            self.loss_w_k + self.radiation_m2 + self.second_loss_w_k > 0.0, "model: a heater without any loss"
        )
        require(-100.0 < self.ambient_c < 150.0, f"model: ambient_c of {self.ambient_c:g} is no room")
        for name in ("heat_slope_per_k", "output_slope_per_k"):
            value = getattr(self, name)
            require(-1e-3 <= value <= 5e-3, f"model: {name} of {value:g} turns the sign within the range")
        climb_k_s = self.max_w / (self.heat_j_k + self.element_j_k)
        require(
            CLIMB_MIN_K_S <= climb_k_s <= CLIMB_MAX_K_S,
            f"model: full power of {self.max_w:.3g} W would heat {self.heat_j_k + self.element_j_k:.3g} J/K by"
            f" {climb_k_s:.2g} K/s",
        )
        through_w_k = self.loss_w_k + (min(self.link_w_k, self.second_loss_w_k) if self.second_j_k else 0.0)
        require(
            self.max_w >= RISE_MIN_K * through_w_k,
            f"model: full power of {self.max_w:.3g} W holds a heater that loses {through_w_k:.3g} W/K only"
            f" {self.max_w / (through_w_k or 1.0):.2g} K above the room",
        )
        linked = self.link_w_k > 0.0
        require(
            (self.second_j_k > 0.0) == linked, "model: a second mass needs both heat and link, or neither"
        )
        linked = self.element_w_k > 0.0
        require((self.element_j_k > 0.0) == linked, "model: an element needs both heat and link, or neither")

    @property
    def max_w(self) -> float:
        return self.output_w * self.output_high

    def packed(self) -> Any:
        """As C's struct model_params, whose fields are named as here; made once."""
        if self._packed is None:
            values = {name: getattr(self, name) for name in _c_fields()}
            object.__setattr__(self, "_packed", chelper.get_ffi()[0].new("struct model_params *", values))
        return self._packed


@cache
def _c_fields() -> tuple[str, ...]:
    return tuple(name for name, _ in chelper.get_ffi()[0].typeof("struct model_params").fields)


def stepped(p: ModelParameters, step_s: float) -> ModelParameters:
    """The same heater, integrated with this step."""
    other = replace(p)
    object.__setattr__(other, "step_s", step_s)
    return other


class Nodes(NamedTuple):
    """Temperatures in degC and the flow (mm^3/s) at the nozzle."""

    element_c: float
    temp_c: float
    second_c: float
    sensor_c: float
    bore_c: float
    flow: float


def nodes_of(raw: Any) -> Nodes:
    """From C's struct model_nodes."""
    return Nodes(raw.element_c, raw.temp_c, raw.second_c, raw.sensor_c, raw.bore_c, raw.flow)


def at_rest(p: ModelParameters, temp_c: float) -> Nodes:
    """All nodes as they are when the controlled one has been held at this temperature for long."""
    return nodes_of(chelper.get_ffi()[1].model_at_rest(p.packed(), temp_c))


def melt_w_k(p: ModelParameters, flow_mm3_s: float) -> float:
    """Heat the melt takes per kelvin of bore above inlet."""
    return float(chelper.get_ffi()[1].model_melt_w_k(p.packed(), flow_mm3_s))


def hold_w(p: ModelParameters, temp_c: float, flow_mm3_s: float, fan: float) -> float:
    """Heat that holds the controlled node at this temperature in the long run."""
    return float(chelper.get_ffi()[1].model_hold_w(p.packed(), temp_c, flow_mm3_s, fan))


def advance(
    p: ModelParameters,
    nodes: Nodes,
    drive: tuple[float, float, float],
    surroundings: tuple[float, float],
    dt_s: float,
) -> Nodes:
    """The nodes `dt_s` later. drive = (output, gain, disturbance_w); surroundings = (flow mm^3/s, fan 0..1)."""
    ffi, lib = chelper.get_ffi()
    raw = ffi.new("struct model_nodes *", nodes)
    lib.model_advance(p.packed(), raw, ffi.new("struct model_drive *", drive), *surroundings, dt_s)
    return nodes_of(raw)
