"""What is wrong with a sensing coil is reported by name; the supply's voltage is put right when it is measured."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from extras.induction import supply as induction_supply
from induction_rig import BATCH_WAIT_S, Plant, Rig, default_parameters
from thermal.sensing import features, laws

# The reference tank's components, as a calibration of the C plant finds them.
TANK = laws.TankLaw(1154.0, 390.0, 1429.0, 0.0, 0.457, 0.599, 0.0, 313.9, 1.003, 0.06)


def hold(rig: Rig, seconds: float, target_c: float = 250.0) -> None:
    rig.run(0.6)
    rig.set_target(target_c)
    rig.run(seconds)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fault": 1.0}, "is the nozzle missing from the coil?"),
        ({"adc_max": 400.0}, "signal clipped"),
    ],
    ids=["missing nozzle", "clipped"],
)
def test_a_signal_that_cannot_be_is_named(changes: dict[str, float], words: str) -> None:
    # the front end's own limit is the ADC's: a plant that clips at 400 has a front end that clips there
    front = features.FeatureParameters(adc_max_raw=int(changes.get("adc_max", 4095)))
    rig = Rig(Plant(3), default_parameters(law=TANK, front=front), 5)
    hold(rig, 2.0, 150.0)
    for name, value in changes.items():
        rig.plant.set_param(name, value)
    rig.set_target(250.0)
    rig.run(4.0)
    assert words in rig.loop.fault
    assert rig.phase == 0


@pytest.mark.parametrize(("noise_lsb", "enough"), [(0.15, False), (1.0, True)])
def test_too_little_noise_is_seen(noise_lsb: float, enough: bool) -> None:
    rig = Rig(Plant(3, noise_lsb=noise_lsb), default_parameters(law=TANK), 5)
    hold(rig, 3.0)
    found = rig.loop.chain.noise_lsb()
    assert found is not None
    assert (found >= features.NOISE_NEEDED_LSB) == enough


@pytest.mark.parametrize("factor", [0.55, 1.6])
def test_a_nozzle_of_another_mass_is_named(factor: float) -> None:
    rig = Rig(Plant(3, mass_factor=factor), default_parameters(law=TANK), 5)
    hold(rig, 4.0)
    assert "wrong nozzle" in rig.loop.state.warning
    assert rig.loop.state.heat_balance.capacity_ratio == pytest.approx(factor, rel=0.1)


@pytest.mark.parametrize(
    "changes",
    [{"l1_slope_per_k": 0.7e-4}, {"l1_slope_per_k": 1.3e-4}, {"l1_uh": 3.7}, {"r_ohm": 0.6}],
    ids=["permeability falls less", "falls more", "other shape", "other resistivity"],
)
def test_a_nozzle_of_another_material_is_named_before_it_is_heated(changes: dict[str, float]) -> None:
    rig = Rig(Plant(3, **changes), default_parameters(law=TANK, loss_uncertainty=0.03), 5)
    rig.run(35.0)  # the heat balance speaks after 30 s
    rig.set_target(200.0)
    words = rig.loop.state.warning
    rig.run(2.1)
    assert "wrong nozzle" in words + rig.loop.fault


@pytest.mark.parametrize("volt", [20.0, 26.0])
def test_a_supply_measured_or_not_leaves_the_reading_true(volt: float) -> None:
    """Not measured it is found by the looks at the sensing phase, where it does not matter."""
    errors = {}
    for supply_v, sent_v in ((24.0, 24.0), (volt, 24.0), (volt, volt)):
        rig = Rig(Plant(3, supply_v=supply_v), default_parameters(law=TANK), 5)
        heater = SimpleNamespace(parameters=rig.loop.parameters, loop=rig.loop)
        induction_supply.set_supply(heater, sent_v)
        hold(rig, 3.0)
        rig.plant.set_inputs(20.0, 0.0)  # melt to heat: 4 % power, where the field matters
        rig.run(4.0)
        trace = rig.trace.arrays()
        late = trace["t_s"] > 4.0
        errors[supply_v, sent_v] = float(np.mean((trace["estimate_c"] - trace["skin_c"])[late]))
    usual = errors[24.0, 24.0]  # what the rounded coefficients above leave
    assert errors[volt, volt] == pytest.approx(usual, abs=0.1)
    assert errors[volt, 24.0] == pytest.approx(usual, abs=0.2)


def test_the_supply_sensor_ignores_a_lead_that_came_off() -> None:
    adc = SimpleNamespace(setup_adc_sample=lambda *a: None, setup_adc_callback=lambda *a: None)
    sensor = induction_supply.SupplySensor(adc, 40.0)
    sensor._on_adc(0.0, 0.6)
    sensor._on_adc(0.05, 0.0)
    assert sensor.volt == pytest.approx(24.0)


def test_a_fault_takes_the_bridge_off_by_one_command_of_the_loop_not_by_the_watchdog() -> None:
    rig = Rig(Plant(3), default_parameters(law=TANK), 5)
    hold(rig, 2.0)
    parameters = rig.loop.parameters
    rig.loop.parameters = replace(parameters, supervise=replace(parameters.supervise, temp_high_c=200.0))
    changed_s = rig.now_s
    while not rig.loop.fault:
        rig.run(0.001)
    # six blocks of 1.6 ms, then the batch of messages that is being gathered
    assert rig.now_s - changed_s < 0.0096 + BATCH_WAIT_S + 0.03
    fault_s, sent = rig.now_s, len(rig.sent_s)
    assert rig.phase > 0 and rig.loop.state.target_c == 0.0
    while rig.phase:
        rig.run(0.001)
    assert rig.now_s - fault_s < parameters.timing.lead_s + 0.002
    rig.run(0.5)
    assert max(rig.trace.phase[-1000:]) == 0 and rig.watchdog_trips == 0
    assert len(rig.sent_s) <= sent + 1  # the one command, sent in the millisecond of the fault or after it
