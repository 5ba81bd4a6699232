"""The calibrated sensing law as parameters of the plant's tank, and the plant along a recorded drive.

Both laws of the signal have the same form (thermal/sensing/laws.py, plant/plant_tank.c). With k = w^2 L2 C1 - 1:

    g = gain 180/pi    w = R/(omega l1 slope)    t0 = Tref    delta = (L2/k - l1)/(l1 slope)    c = gain 360 f skew
    b, q of the saturation: x^2 = kappa u, kappa = (4 Vdc/(pi R k Isat))^2, b = 0.457 kappa, q = 0.599 kappa^4

A law has one number for what C1, L1, L2 and frequency do together: L1, its slope, L2 and f keep the preset's values.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import cffi
import numpy as np

from chelper.compiler import read_headers
from simulation.world import API_HEADER, WORLD_LIBRARY, parameter_tables, parameter_values
from thermal.control.loop import LoopParameters
from thermal.sensing.laws import ExpLaw, Law, TankLaw

from .recording import Array, RunError

FOLLOW_HEADER = API_HEADER.parents[1] / "plant" / "plant_follow.h"
FREQUENCY_HZ = 120e3


@cache
def _library() -> tuple[cffi.FFI, Any]:
    ffi = cffi.FFI()
    ffi.cdef(read_headers([FOLLOW_HEADER]))
    return ffi, ffi.dlopen(str(WORLD_LIBRARY))


def follow(changes: dict[str, float], steps: Array) -> tuple[Array, Array]:
    """Mean temperature and code of each step; `changes`: parameters of the plant that differ from the preset."""
    ffi, lib = _library()
    values = ffi.new("double[]", parameter_values("nozzle", "reference", changes))
    skin_c, raw = np.empty(len(steps)), np.empty(len(steps))
    cast = [ffi.from_buffer("double[]", a) for a in (skin_c, raw)]
    lib.plant_follow(values, ffi.cast("struct follow_step *", ffi.from_buffer(steps)), len(steps), *cast)
    return skin_c, raw


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
        **_signal(parameters.estimator.law, drive.vdc_reference_v),
    }


def _signal(law: Law, supply_v: float) -> dict[str, float]:
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
    # One kappa for b and q: the two saturations agree best over the drives that are used.
    kappa = 0.5 * (law.b / 0.457 + (law.q / 0.599) ** 0.25)
    gain = math.radians(law.g)
    return {
        "gain_units_deg": gain,
        "l1_reference_c": law.t0,
        "r_ohm": r_ohm,
        "c1_uf": 1e6 * (ratio + 1.0) / (omega**2 * 1e-6 * preset["l2_uh"]),
        "l1_saturation_a": 4.0 * supply_v / (math.pi * r_ohm * ratio * math.sqrt(kappa)),
        "skew_ns": law.c / (gain * 360.0 * FREQUENCY_HZ * 1e-9),
        "offset_units": law.d,
        "offset_decay": law.m,
    }
