"""Two designs the field ships, written from their public documentation, on the same C plant as ours.

`IndxLike`: a board of its own at the nozzle that controls at 100 Hz and reports every 100 ms (docs.kalico.gg, INDX):
proportional on a contactless sensor, the losses at the target fed forward from the host's side at each report.

`MpcLike`: MPC as documented (Kalico, Marlin's M306): a simulated block of one heat capacity and one
loss, run in steps of the sensor's report, dragged gently towards the reading, its ambient temperature trimmed by what
is left; power is what brings the simulated block to the target within a set time, plus loss and filament heat.

Both are given more than they have: the true skin temperature with little noise instead of their sensors (a
thermopile's lag for the first), no link between controller and heater, and gains picked for this very plant.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from control_figures import BAND_C, Programme, Result, settled_s
from induction_rig import CHUNK, PERIOD_S, Plant
from thermal.models import heat_loss
from thermal.models.drive_law import DriveLaw

SENSOR_NOISE_C = 0.05
COMMAND_S = 0.005  # a new target on its way to the heater, as ours (loop.PROMPT_S)


class Peer(Protocol):
    period_s: float

    def power(self, now_s: float, temp_c: float, target_c: float, flow_mm3_s: float) -> float: ...


@dataclass
class IndxLike:
    """Watts from the board's own loop."""

    power_max_w: float = 81.3
    kp_w_k: float = 20.0  # of 6, 12, 20, 30 the largest that overshoots by less than 3 degC
    sensor_s: float = 0.025  # a thermopile and its filter [assumed]
    report_s: float = 0.100
    period_s: float = 0.010
    loss: heat_loss.LossLaw = field(default_factory=heat_loss.LossLaw)
    _seen_c: float = math.nan
    _fed_w: float = 0.0
    _reported_s: float = -math.inf

    def power(self, now_s: float, temp_c: float, target_c: float, flow_mm3_s: float) -> float:
        if math.isnan(self._seen_c):
            self._seen_c = temp_c
        self._seen_c += (temp_c - self._seen_c) * self.period_s / (self.period_s + self.sensor_s)
        if now_s - self._reported_s >= self.report_s:
            self._reported_s = now_s
            self._fed_w = heat_loss.loss_w(self.loss, target_c)
        wanted = self._fed_w + self.kp_w_k * (target_c - self._seen_c)
        return min(self.power_max_w, max(0.0, wanted))


@dataclass
class MpcLike:
    """Watts from one simulated block."""

    power_max_w: float = 81.3
    period_s: float = 0.25
    reach_s: float = 0.3  # of 0.3, 0.5, 1, 2 s the best on this plant
    drag: float = 0.25  # share of the difference taken over at each reading
    heat_j_k: float = 0.44
    loss_w_k: float = 0.0205  # 4.7 W at 250 degC
    ambient_c: float = 20.0
    melt_j_mm3_k: float = 2.1e-3
    trim: float = 0.3  # of the ambient temperature per degree the reading differs, once near the target
    _block_c: float = math.nan
    _power_w: float = 0.0
    _flow: float = 0.0

    def power(self, now_s: float, temp_c: float, target_c: float, flow_mm3_s: float) -> float:
        if math.isnan(self._block_c):
            self._block_c = temp_c
        taken_w = self._taken(self._block_c, self._flow)
        self._block_c += (self._power_w - taken_w) * self.period_s / self.heat_j_k
        off_c = temp_c - self._block_c
        self._block_c += off_c * self.drag
        if abs(target_c - self._block_c) < 25.0:
            self.ambient_c += self.trim * off_c
        self._flow = flow_mm3_s
        climb_w = (target_c - self._block_c) / self.reach_s * self.heat_j_k
        wanted = climb_w + self._taken(target_c, flow_mm3_s)
        self._power_w = min(self.power_max_w, max(0.0, wanted))
        return self._power_w

    def _taken(self, temp_c: float, flow_mm3_s: float) -> float:
        # filament heat as documented: all of it up to the block's temperature
        return self.loss_w_k * (temp_c - self.ambient_c) + self.melt_j_mm3_k * flow_mm3_s * (temp_c - 25.0)


class PeerRig:
    """A peer at the plant."""

    def __init__(self, plant: Plant, peer: Peer, power_full_w: float, seed: int = 0) -> None:
        self.plant, self.peer = plant, peer
        self.law = DriveLaw(power_full_w=power_full_w)
        self.random = random.Random(seed)
        self.period, self.next_s, self.target_c, self.flow = 0, 0.0, 0.0, 0.0
        self.t_s: list[float] = []
        self.skin_c: list[float] = []

    @property
    def now_s(self) -> float:
        return self.period * PERIOD_S

    def set_target(self, target_c: float) -> None:
        """The peer's host is as far away as ours."""
        self.run(COMMAND_S)
        self.target_c = target_c

    def set_flow(self, flow_mm3_s: float) -> None:
        self.flow = flow_mm3_s
        self.plant.set_inputs(flow_mm3_s, 0.0)

    def run(self, duration_s: float) -> None:
        end = self.period + round(duration_s / PERIOD_S)
        while self.period < end:
            if self.now_s >= self.next_s:
                self.next_s += self.peer.period_s
                seen_c = self.plant.read().skin_c + self.random.gauss(0.0, SENSOR_NOISE_C)
                watts = (
                    self.peer.power(self.now_s, seen_c, self.target_c, self.flow) if self.target_c else 0.0
                )
                self.plant.set_phase(round(self.law.phase_ticks(watts)))
            self.plant.lib.plant_advance(self.plant._p, CHUNK * PERIOD_S)
            self.period += CHUNK
            self.t_s.append(self.now_s)
            self.skin_c.append(self.plant.read().skin_c)


PEERS = {"indx-like": IndxLike, "mpc-like": MpcLike}
POWER_W = {"reference": 81.3, "strong": 282.0}
START_C, TARGET_C, STEP_C, FLOW_MM3_S = 25.0, 250.0, 25.0, 25.0
HOLD_S, FLOW_S, STEP_S = 3.0, 1.0, 1.0


def min_s(preset: str, start_c: float, target_c: float) -> float:
    """Full power with perfect knowledge, from the command on until the band is reached."""
    plant = Plant(1, preset, start_c=start_c)
    plant.set_phase(45000)
    step_s, n = 0.5e-3, 0
    while plant.read().skin_c < target_c - BAND_C:
        plant.lib.plant_advance(plant._p, step_s)
        n += 1
    return n * step_s


def run(name: str, preset: str, seed: int = 5) -> Result:
    """The programme of config/studies/control.gcode with a peer."""
    power_w = POWER_W[preset]
    rig = PeerRig(Plant(seed, preset, start_c=START_C), PEERS[name](power_w), power_w, seed)
    rig.set_target(TARGET_C)
    optimal_s = min_s(preset, START_C, TARGET_C)
    rig.run(optimal_s + HOLD_S)
    ends = [rig.now_s]
    for flow in (FLOW_MM3_S, 0.0):
        rig.set_flow(flow)
        rig.run(FLOW_S)
        ends.append(rig.now_s)
    rig.set_target(TARGET_C + STEP_C)
    rig.run(STEP_S)
    t_s, skin_c = np.asarray(rig.t_s), np.asarray(rig.skin_c)
    programme = Programme(
        TARGET_C, 0.0, ends[0], ends[1], ends[2], watched_s=(1.0, 0.3), t_s=t_s, temp_c=skin_c
    )
    step_s = settled_s(t_s, skin_c, ends[-1], rig.now_s, TARGET_C + STEP_C)
    return programme.result(name, preset, optimal_s, step_s, min_s(preset, TARGET_C, TARGET_C + STEP_C))
