"""What the control bench and its short tests measure: one programme, any controller, any plant.

    start at 25 degC ─ 250 ─ hold ─ flow 0 -> 25 -> 0 mm^3/s ─ +25 degC ─ end

All temperatures are the C plant's true skin. The law of the thermometer is the calibrated one of that plant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from induction_rig import PERIOD_S, Plant, Rig, default_parameters, true_law
from peers import IndxLike, MpcLike, PeerRig
from thermal.control.control_api import Schedule

START_C, TARGET_C, STEP_C, FLOW_MM3_S = 25.0, 250.0, 25.0, 25.0
BAND_C = 3.0
IDLE_S, HOLD_S, FLOW_S, STEP_S = 0.6, 3.0, 1.0, 1.0
FLOW_KNOWN_S = 0.25  # look-ahead: moves stand in the queue this long before they happen
POWER_W = {"reference": 81.3, "strong": 282.0}
OURS = ("model", "pid", "two_period", "watermark")
PEERS = ("indx-like", "mpc-like")

PLANTS: dict[str, tuple[str, dict[str, float]]] = {
    "reference": ("reference", {}),
    "strong": ("strong", {}),
    **{
        f"{name} x{factor}": ("reference", {f"{name}_factor": factor})
        for name in ("mass", "loss", "efficiency")
        for factor in (0.7, 1.3)
    },
    "strong mass x0.7": ("strong", {"mass_factor": 0.7}),
    "strong efficiency x1.3": ("strong", {"efficiency_factor": 1.3}),
    "bore lag x1.3": ("reference", {"bore_tau_s": 0.064}),
    "light, strong, no loss": (
        "reference",
        {"mass_factor": 0.8, "efficiency_factor": 1.2, "loss_factor": 0.8},
    ),
    "heavy, weak, lossy": ("reference", {"mass_factor": 1.2, "efficiency_factor": 0.8, "loss_factor": 1.2}),
}


@dataclass(frozen=True)
class Link:
    """The way between host and MCU; late: control steps come late by up to this, at random."""

    name: str = "good"
    up_s: float = 0.003
    down_s: float = 0.002
    jitter_s: float = 0.005
    late_s: float = 0.0


GOOD = Link()
# 250 kBaud: a message of 40 bytes takes 1.6 ms; the sensor delay of the list of plants is this way's.
JITTERY = Link("late by up to 50 ms", 0.0046, 0.0036, 0.005, 0.050)
SLOW = Link("sensor delay x1.3", 0.0105, 0.002, 0.005)


@dataclass(frozen=True)
class Result:
    """Figures of one run, degC and s."""

    controller: str
    plant: str
    link: str
    settle_s: float  # 25 -> 250, last time outside +-3 degC
    optimal_s: float
    overshoot_c: float
    hold_c: float  # worst error over the last second of the hold
    ripple_c: float  # peak to peak over that second
    flow_deviation_c: float
    flow_steady_c: float  # |mean error| over the last 0.3 s with flow
    step_s: float  # +25 degC, last time outside +-3 degC
    step_min_s: float  # full power from the command on
    late: int
    trips: int
    fault: str
    trace: Any = field(default=None, repr=False, compare=False)

    @property
    def settle_ratio(self) -> float:
        return self.settle_s / self.optimal_s

    @property
    def step_over_s(self) -> float:
        return self.step_s - self.step_min_s


class OurRig(Rig):
    """The rig with what the printer gives the loop: the planned flow; and with a host that is late at random."""

    def __init__(self, plant: Plant, parameters: Any, seed: int, link: Link) -> None:
        super().__init__(plant, parameters, seed, link.up_s, link.down_s, link.jitter_s)
        self.late_s = link.late_s
        self._awake_s = 0.0

    def set_flow(self, flow_mm3_s: float, planned: bool = True) -> None:
        """The flow changes FLOW_KNOWN_S from now: run that long, then go on."""
        at_s = self.now_s + FLOW_KNOWN_S
        if planned:
            self.loop.flow = Schedule((at_s,), (flow_mm3_s,), self.loop.flow.at(self.now_s))
        self.run(FLOW_KNOWN_S)
        self.plant.set_inputs(flow_mm3_s, 0.0)

    def _host(self) -> None:
        """A late host sleeps through a stretch of up to late_s now and then, then does all at once."""
        if self.late_s:
            if self.now_s < self._awake_s:
                return
            if self.random.random() < CHUNK_SHARE:
                self._awake_s = self.now_s + self.random.random() * self.late_s
        super()._host()

    def skin(self) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.trace.t_s), np.asarray(self.trace.skin_c)


CHUNK_SHARE = 0.02  # a nap begins about every 14 ms of being awake: the host is late as often as not


def make_rig(controller: str, plant_name: str, link: Link, seed: int = 5) -> Any:
    """A rig of ours or of a peer, at rest at START_C."""
    preset, changes = PLANTS[plant_name]
    return build_rig(controller, preset, changes, link, seed)


def build_rig(controller: str, preset: str, changes: Mapping[str, float], link: Link, seed: int = 5) -> Any:
    plant = Plant(seed, preset, start_c=START_C, **changes)
    power_w = POWER_W[preset]
    if controller == "indx-like":
        return PeerRig(plant, IndxLike(power_w), power_w, seed)
    if controller == "mpc-like":
        return PeerRig(plant, MpcLike(power_w), power_w, seed)
    parameters = default_parameters(law=true_law(), control=controller, power_full_w=power_w)
    return OurRig(plant, parameters, seed, link)


def replaced(parameters: Any, chosen: Any, law: Any) -> Any:
    """Loop parameters with another law in the place of the chosen one."""
    return replace(parameters, control=replace(chosen, law=law))


def min_s(preset: str, changes: Mapping[str, float], start_c: float, target_c: float) -> float:
    """Bang-bang with perfect knowledge: full power from the command on until the band is reached."""
    plant = Plant(1, preset, start_c=start_c, **changes)
    plant.set_phase(45000)
    step_s, n = 0.5e-3, 0
    while plant.read().skin_c < target_c - BAND_C:
        plant.lib.plant_advance(plant._p, step_s)
        n += 1
    return n * step_s


def _settled(t_s: np.ndarray, skin_c: np.ndarray, start_s: float, end_s: float, target_c: float) -> float:
    """Last time outside the band, from start_s."""
    select = (t_s > start_s) & (t_s <= end_s)
    outside = t_s[select][np.abs(skin_c[select] - target_c) > BAND_C]
    return float(outside[-1] - start_s) if len(outside) else 0.0


def run(controller: str, plant_name: str, link: Link = GOOD, seed: int = 5, planned: bool = True) -> Result:
    """The whole programme."""
    preset, changes = PLANTS[plant_name]
    rig = make_rig(controller, plant_name, link, seed)
    rig.run(IDLE_S)
    heat_s = rig.now_s
    rig.set_target(TARGET_C)
    optimal_s = min_s(preset, changes, START_C, TARGET_C)
    rig.run(optimal_s + HOLD_S)
    held_s = rig.now_s
    flow_ends = []
    for flow in (FLOW_MM3_S, 0.0):
        rig.set_flow(flow, planned)
        rig.run(FLOW_S)
        flow_ends.append(rig.now_s)
    step_at_s = rig.now_s
    rig.set_target(TARGET_C + STEP_C)
    rig.run(STEP_S)
    t_s, skin_c = rig.skin()

    def part(start_s: float, end_s: float) -> np.ndarray:
        return skin_c[(t_s > start_s) & (t_s <= end_s)] - TARGET_C

    # from the plant as it is then, second mass and all: its slope at full power, once that holds
    slope = _full_slope(preset, changes)
    fault = getattr(getattr(rig, "loop", rig), "fault", "")
    return Result(
        controller,
        plant_name,
        link.name,
        _settled(t_s, skin_c, heat_s, held_s, TARGET_C),
        optimal_s,
        max(0.0, float(part(heat_s, held_s).max())),
        float(np.abs(part(held_s - 1.0, held_s)).max()),
        float(np.ptp(part(held_s - 1.0, held_s))),
        float(np.abs(part(held_s, flow_ends[1])).max()),
        float(abs(part(flow_ends[0] - 0.3, flow_ends[0]).mean())),
        _settled(t_s, skin_c, step_at_s, step_at_s + STEP_S, TARGET_C + STEP_C),
        (STEP_C - BAND_C) / slope,
        rig.late,
        rig.watchdog_trips,
        fault,
        (t_s - heat_s, skin_c),
    )


def _full_slope(preset: str, changes: Mapping[str, float]) -> float:
    """K/s at full power around the step, the second mass as warm as after the programme so far."""
    plant = Plant(1, preset, start_c=TARGET_C, **changes)
    plant.set_phase(45000)
    plant.lib.plant_advance(plant._p, 0.05)
    before = plant.read().skin_c
    plant.lib.plant_advance(plant._p, 0.02)
    return float((plant.read().skin_c - before) / 0.02)


__all__ = [
    "GOOD",
    "JITTERY",
    "OURS",
    "PEERS",
    "PERIOD_S",
    "PLANTS",
    "SLOW",
    "Link",
    "Result",
    "make_rig",
    "min_s",
    "run",
]
