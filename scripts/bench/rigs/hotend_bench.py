"""The conventional hotend under the same laws: the C plant thermal_load.c, a thermistor, one report each 0.3 s.

    reading at t ─ law ─ duty in force from t + 0.6 s (as extras/heaters.py has it)

Programme: 25 -> 220 degC, hold, flow 0 -> 10 -> 0 mm^3/s, +20 degC. True temperature: the block's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from control_figures import BAND_C, Programme, Result, settled_s
from induction_rig import plant_library
from thermal.control import pid, predictive, two_period
from thermal.control.control_api import ControlInput, Schedule
from thermal.models.heater_model import ModelParameters

REPORT_S, DELAY_S, STEP_S = 0.3, 0.6, 0.05
SAMPLES = 8
TARGET_C, MORE_C, FLOW_MM3_S = 220.0, 20.0, 10.0
FLOW_KNOWN_S = 0.5
HOLD_S, FLOW_S, STEP_AFTER_S = 90.0, 60.0, 60.0
REPORTS_S = 0.9  # three readings: the law knows where it stands

# What a calibration finds of the plant's parameters; duty in, watts of the cartridge inside.
HOTEND = ModelParameters(
    heat_j_k=15.0,
    loss_w_k=0.0705,
    output_w=40.0,
    output_high=1.0,
    ambient_c=22.5,
    element_j_k=2.0,
    element_w_k=0.5,
    sensor_s=1.5,
    fan_w_k=0.03,
    melt_ua_w_k=0.060,
    flow_s=0.02,
    hold_s=REPORT_S,
    horizon_s=3.0,
    tau_s=3.0,
    band_c=2.0,
    sigma_c=0.08,
    disturbance_w=0.4,
    disturbance_start_w=1.0,
    temp_walk_c=0.01,
    delay_s=DELAY_S,
)
PID = pid.klipper_pid(22.2, 1.08, 114.0, 1.0, 1.0)  # a common hotend's, as in sample configurations
LAWS: dict[str, tuple[Any, Any]] = {
    "model": (predictive.MODEL, HOTEND),
    "pid": (pid.PID, PID),
    "two_period": (two_period.TWO_PERIOD, two_period.TwoPeriodParameters(1.0)),
    "watermark": (pid.WATERMARK, pid.WatermarkParameters(2.0, 1.0)),
}
PLANTS: dict[str, dict[str, float]] = {
    "hotend": {},
    "hotend mass x1.25": {"mass_factor": 1.25},
    "hotend mass x0.8": {"mass_factor": 0.8},
    "hotend loss x1.3": {"loss_factor": 1.3},
    "hotend heater x0.8": {"supply_factor": math.sqrt(0.8)},
    "hotend sensor x1.3": {"sensor_tau_s": 1.95},
    "hotend sensor x0.7": {"sensor_tau_s": 1.05},
}


class HotendRig:
    """One hotend under one law."""

    def __init__(self, law: Any, parameters: Any, seed: int, changes: Mapping[str, float]) -> None:
        self.ffi, self.lib = plant_library("thermal_load.h")
        params = self.lib.thermal_load_params
        names = [self.ffi.string(params[i].name).decode() for i in range(self.lib.thermal_load_param_count)]
        values = [changes.get(name, params[i].hotend) for i, name in enumerate(names)]
        self.v = dict(zip(names, values, strict=True))
        self.load = self.ffi.gc(self.lib.thermal_load_new(), self.lib.thermal_load_free)
        self.lib.thermal_load_init(self.load, self.ffi.new("double[]", values), seed)
        self.law, self.parameters, self.state = law, parameters, law.start
        self.now_s = self.report_s = self.target_c = self.flow = 0.0
        self.plan = Schedule()
        self.duties: list[tuple[float, float]] = []
        self.t_s: list[float] = []
        self.body_c: list[float] = []
        self._codes = self.ffi.new("uint16_t[]", SAMPLES)
        self._out = self.ffi.new("struct thermal_load_outputs *")

    def reading(self) -> float:
        """Mean of some samples through the thermistor's own law."""
        self.lib.thermal_load_sample(self.load, self._codes, SAMPLES)
        ratio = sum(self._codes[i] for i in range(SAMPLES)) / SAMPLES / self.v["adc_max"]
        ohm = self.v["pullup_ohm"] * ratio / (1.0 - ratio)
        inverse = 1.0 / 298.15 + math.log(ohm / self.v["thermistor_r25_ohm"]) / self.v["thermistor_beta_k"]
        return 1.0 / inverse - 273.15

    def _control(self) -> None:
        self.report_s += REPORT_S
        inputs = ControlInput(
            self.target_c, self.reading(), apply_s=self.now_s + DELAY_S, flow_mm3_s=self.plan
        )
        output, self.state = self.law.step(self.parameters, self.state, inputs, self.now_s)
        self.duties.append((self.now_s + DELAY_S, output.value if self.target_c else 0.0))

    def run(self, duration_s: float) -> None:
        end_s = self.now_s + duration_s
        while self.now_s < end_s - 1e-9:
            if self.now_s >= self.report_s - 1e-9:
                self._control()
            while self.duties and self.duties[0][0] <= self.now_s + 1e-9:
                self.lib.thermal_load_set_duty(self.load, self.duties.pop(0)[1])
            self.lib.thermal_load_advance(self.load, STEP_S)
            self.now_s += STEP_S
            self.lib.thermal_load_read(self.load, self._out)
            self.t_s.append(self.now_s)
            self.body_c.append(self._out.body_c)

    def set_flow(self, flow_mm3_s: float) -> None:
        self.plan = Schedule((self.now_s + FLOW_KNOWN_S,), (flow_mm3_s,), self.flow)
        self.run(FLOW_KNOWN_S)
        self.flow = flow_mm3_s
        self.lib.thermal_load_set_inputs(self.load, flow_mm3_s, 0.0)


def step_time_s(law: Any, parameters: Any, changes: Mapping[str, float], seed: int) -> float:
    """A step from a hotend that is at the target all through, so that no law's cycle or hot element helps it."""
    rig = HotendRig(law, parameters, seed, {**changes, "start_c": TARGET_C})
    rig.target_c = TARGET_C
    rig.run(REPORTS_S)
    begun_s, rig.target_c = rig.now_s, TARGET_C + MORE_C
    rig.run(STEP_AFTER_S)
    t_s, body_c = np.asarray(rig.t_s), np.asarray(rig.body_c)
    return settled_s(t_s, body_c, begun_s, rig.now_s, TARGET_C + MORE_C)


def min_s(changes: Mapping[str, float], start_c: float, target_c: float) -> float:
    """Full power from the command on until the band is reached."""
    rig = HotendRig(pid.PID, PID, 1, {**changes, "start_c": start_c})
    rig.lib.thermal_load_set_duty(rig.load, 1.0)
    elapsed_s = 0.0
    while True:
        rig.lib.thermal_load_advance(rig.load, STEP_S)
        elapsed_s += STEP_S
        rig.lib.thermal_load_read(rig.load, rig._out)
        if rig._out.body_c >= target_c - BAND_C:
            return elapsed_s


def run(controller: str, plant_name: str, seed: int = 3, parameters: Any = None) -> Result:
    """The whole programme with one law."""
    changes = PLANTS[plant_name]
    law, own = LAWS[controller]
    rig = HotendRig(law, parameters or own, seed, {**changes, "start_c": 25.0})
    rig.run(3.0)
    heat_s, rig.target_c = rig.now_s, TARGET_C
    optimal_s = min_s(changes, 25.0, TARGET_C)
    rig.run(optimal_s + HOLD_S)
    held_s = rig.now_s
    ends = []
    for flow in (FLOW_MM3_S, 0.0):
        rig.set_flow(flow)
        rig.run(FLOW_S)
        ends.append(rig.now_s)
    programme = Programme(
        TARGET_C,
        heat_s,
        held_s,
        ends[0],
        ends[1],
        watched_s=(20.0, 20.0),
        t_s=np.asarray(rig.t_s),
        temp_c=np.asarray(rig.body_c),
    )
    step_s = step_time_s(law, parameters or own, changes, seed)
    return programme.result(
        controller, plant_name, optimal_s, step_s, min_s(changes, TARGET_C, TARGET_C + MORE_C)
    )
