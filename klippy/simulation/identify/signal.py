"""The calibrated sensing law as parameters of the plant's tank, and the plant along a recorded drive.

Both laws of the signal have the same form (thermal/sensing/laws.py, plant/plant_tank.c). With k = w^2 L2 C1 - 1:

    g = gain 180/pi    w = R/(omega l1 slope)    t0 = Tref    delta = (L2/k - l1)/(l1 slope)    c = gain 360 f skew
    b, q of the saturation: x^2 = kappa u, kappa = (4 Vdc/(pi R k Isat))^2, b = 0.457 kappa, q = 0.599 kappa^4

A law has one number for what C1, L1, L2 and frequency do together: L1, its slope, L2 and f keep the preset's values.
It has two, b and q, where the tank has kappa. A fit over temperature and drive finds the tank that is nearest to it.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import cffi
import numpy as np

from chelper.compiler import read_headers
from simulation.world import API_HEADER, WORLD_LIBRARY, parameter_tables, parameter_values
from thermal.control.loop_records import LoopParameters
from thermal.models.drive_law import DriveLaw
from thermal.sensing.laws import ExpLaw, Law, TankLaw

from .recording import Array, RunError

FOLLOW_HEADER = API_HEADER.parents[1] / "plant" / "plant_follow.h"
FREQUENCY_HZ = 120e3
TEMPS_C, DRIVES = (
    np.linspace(20.0, 350.0, 12),
    np.linspace(0.002, 1.0, 15),
)  # where a tank has to be as its law
HOLD = 1.0  # 1 unit of all together weighs as much as the whole of a parameter


@cache
def _library() -> tuple[cffi.FFI, Any]:
    ffi = cffi.FFI()
    ffi.cdef(read_headers([FOLLOW_HEADER]))
    return ffi, ffi.dlopen(str(WORLD_LIBRARY))


def follow(changes: dict[str, float], steps: Array) -> Array:
    """Mean code of each step; `changes`: parameters of the plant that differ from the preset."""
    ffi, lib = _library()
    values = ffi.new("double[]", parameter_values("nozzle", "reference", changes))
    raw = np.empty(len(steps))
    rows = ffi.cast("struct follow_step *", ffi.from_buffer(steps))
    lib.plant_follow(values, rows, len(steps), ffi.from_buffer("double[]", raw))
    return raw


def tank_of(parameters: LoopParameters) -> dict[str, float]:
    """Parameters of the plant whose signal the loop's law reads. Raises RunError."""
    front, drive = parameters.front, parameters.actuator.law
    return {
        "adc_zero": front.adc_zero_raw,
        "units_per_lsb": front.units_per_lsb,
        "adc_max": float(front.adc_max_raw),
        "supply_nominal_v": drive.vdc_reference_v,
        "heat_w": drive.power_full_w,
        "heat_exponent": drive.exponent,
        **_signal(parameters.estimator.law, drive),
    }


def _signal(law: Law, drive: DriveLaw) -> dict[str, float]:
    if isinstance(law, ExpLaw):
        names = ("law_slope", "law_decay", "law_zero", "law_power")
        return {"signal_model": 1.0, **dict(zip(names, (law.a, law.b, law.c, law.d), strict=True))}
    if not isinstance(law, TankLaw):
        raise RunError(
            f"the plant has no signal of the kind of the law '{type(law).__name__}'; calibrate the nozzle"
        )
    preset = {name: row.presets["reference"] for name, row in parameter_tables()["nozzle"].items()}
    omega, l1, slope = 2.0 * math.pi * FREQUENCY_HZ, 1e-6 * preset["l1_uh"], preset["l1_slope_per_k"]
    ratio = 1e-6 * preset["l2_uh"] / (l1 * (1.0 + slope * law.delta))
    r_ohm = law.w * omega * l1 * slope
    gain = math.radians(law.g)
    tank = {
        "gain_units_deg": gain,
        "l1_reference_c": law.t0,
        "r_ohm": r_ohm,
        "c1_uf": 1e6 * (ratio + 1.0) / (omega**2 * 1e-6 * preset["l2_uh"]),
        "l1_saturation_a": 4.0 * drive.vdc_reference_v / (math.pi * r_ohm * ratio * math.sqrt(law.b / 0.457)),
        "skew_ns": law.c / (gain * 360.0 * FREQUENCY_HZ * 1e-9),
        "offset_units": law.d,
        "offset_decay": law.m,
    }
    return _nearest(tank, law, drive)


def _nearest(tank: dict[str, float], law: Law, drive: DriveLaw) -> dict[str, float]:
    """The tank nearest to the law, by Gauss and Newton; held at the start where the law leaves it free."""
    phases = drive.phase_max_ticks * np.sqrt(DRIVES)
    steps = np.zeros((len(phases), 4))
    steps[:, 0], steps[:, 1] = 1e-9, phases
    wanted = np.array([[law.error(t, p) for p in phases] for t in TEMPS_C]).ravel()
    names, start = list(tank), np.array(list(tank.values()))

    def units(x: Array) -> Array:
        changes = dict(zip(names, (start * (1.0 + x)).tolist(), strict=True))
        fixed = {"heat_w": 0.0, "adc_zero": 0.0, "supply_v": drive.vdc_reference_v}
        return np.concatenate([follow({**changes, **fixed, "start_c": t}, steps) for t in TEMPS_C])

    x = np.zeros(len(names))
    for _ in range(4):
        here = units(x)
        slopes = np.column_stack([(units(x + 1e-6 * unit) - here) / 1e-6 for unit in np.eye(len(x))])
        normal = slopes.T @ slopes + HOLD * np.eye(len(x))
        x = x + np.linalg.solve(normal, slopes.T @ (wanted - here) - HOLD * x)
    return dict(zip(names, (start * (1.0 + x)).tolist(), strict=True))
