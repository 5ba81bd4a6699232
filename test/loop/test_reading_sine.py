"""A sine on the reading (vibration, a chopper's beat) reaches the true temperature hardly stronger than it is."""

from __future__ import annotations

import math

import numpy as np
import pytest

import peers
from induction_rig import Plant, Rig, default_parameters, true_law

UNITS_PER_C = 0.795  # of the signal at little drive and 250 degC
TARGET_C = 250.0


def held(preset: str) -> Rig:
    parameters = default_parameters(law=true_law(), power_full_w=peers.POWER_W[preset])
    rig = Rig(Plant(5, preset, start_c=25.0), parameters, 5)
    rig.run(0.6)
    rig.set_target(TARGET_C)
    rig.run(3.0)
    return rig


def answer(rig: Rig, frequency_hz: float, amplitude_c: float) -> tuple[float, float]:
    """Gain at that frequency from the reading to the skin, and by how much its mean is off."""
    rig.plant.set_param("emi_hz", frequency_hz)
    rig.plant.set_param("emi_lsb", amplitude_c * UNITS_PER_C)
    rig.run(3.0)
    first = len(rig.trace.t_s)
    rig.run(max(2.0, 2.0 / frequency_hz))
    rig.plant.set_param("emi_lsb", 0.0)
    turn = 2.0 * math.pi * frequency_hz * np.array(rig.trace.t_s[first:])
    shapes = np.column_stack([np.ones_like(turn), np.sin(turn), np.cos(turn)])
    skin_c = np.array(rig.trace.skin_c[first:]) - TARGET_C
    shift_c, *parts = np.linalg.lstsq(shapes, skin_c, rcond=None)[0]
    rig.run(1.0)
    return math.hypot(*parts) / amplitude_c, float(shift_c)


@pytest.mark.parametrize("preset", ["reference", "strong"])
@pytest.mark.parametrize("amplitude_c", [0.25, 1.0])
def test_a_sine_on_the_reading_is_hardly_amplified_and_does_not_shift_the_mean(
    preset: str, amplitude_c: float
) -> None:
    rig = held(preset)
    for frequency_hz in (0.5, 1.2, 3.0, 20.0):
        gain, shift_c = answer(rig, frequency_hz, amplitude_c)
        assert gain <= 1.5, frequency_hz
        assert abs(shift_c) <= 0.3, frequency_hz
    assert not rig.loop.fault


@pytest.mark.parametrize("preset", ["reference", "strong"])
def test_a_strong_swing_is_ridden_through(preset: str) -> None:
    rig = held(preset)
    for frequency_hz, limit in ((0.3, 1.5), (1.0, 1.5), (20.0, 0.05), (50.0, 0.05)):
        assert answer(rig, frequency_hz, 4.0)[0] <= limit, frequency_hz
    assert not rig.loop.fault


def test_a_bridge_that_need_not_heat_measures_every_ten_milliseconds() -> None:
    rig = held("reference")
    ends_s: list[float] = []
    rig.loop.listeners.append(
        lambda block, *_: ends_s.append(block.time_s + block.duration_s) if block.phase_ticks else None
    )
    rig.set_target(150.0)
    rig.run(0.1)
    ends_s.clear()
    rig.run(1.0)
    assert max(rig.trace.phase[-1000:]) == rig.loop.parameters.actuator.phase_low_ticks
    assert np.diff(ends_s).max() < 0.010
