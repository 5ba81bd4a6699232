"""Pins move, heat and read the right things (klippy/simulation/world/machine.c), with a fake MCU working the pins."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from simulation import world as world_module
from simulation.world import Pin, WorldError, parameter_values
from world_rig import Rig, build_fake

STEP, DIR, ENDSTOP, FAN, HEATER, SENSOR = (Pin(0, n) for n in (1, 2, 3, 4, 5, 6))


@pytest.fixture(scope="module")
def fake(tmp_path_factory: pytest.TempPathFactory) -> Path:
    world_module.build()
    return build_fake(tmp_path_factory.mktemp("fake"))


@pytest.fixture
def rig(fake: Path) -> Rig:
    return Rig(fake)


def add_axis(rig: Rig, **options: object) -> int:
    values = {"start_mm": 5.0, "limits_mm": (-1.0, 20.0), "endstop": ENDSTOP, **options}
    return rig.world.add_axis("X", STEP, DIR, 0.01, **values)  # type: ignore[arg-type]


def test_each_pulse_moves_the_axis_one_step_in_the_direction_of_the_dir_pin(rig: Rig) -> None:
    axis = add_axis(rig)
    rig.start()
    rig.steps(STEP, DIR, 30, forward=True)
    rig.steps(STEP, DIR, 10, forward=False)
    state = rig.world.axis(axis)
    assert (state["steps_forward"], state["steps_backward"]) == (30, 10)
    assert state["position_mm"] == pytest.approx(5.2, abs=1e-9)


def test_a_driver_on_both_edges_steps_twice_a_pulse(rig: Rig) -> None:
    axis = add_axis(rig, both_edges=True)
    rig.start()
    rig.steps(STEP, DIR, 7, forward=True)
    assert rig.world.axis(axis)["steps_forward"] == 14


def test_inverted_pins_step_on_the_falling_edge_and_turn_the_other_way(rig: Rig) -> None:
    axis = rig.world.add_axis("X", Pin(0, 1, True), Pin(0, 2, True), 0.01)
    rig.start()
    rig.write(STEP, 1)  # idle level of an inverted step pin: no step
    assert rig.world.axis(axis)["steps_forward"] + rig.world.axis(axis)["steps_backward"] == 0
    rig.write(DIR, 0)
    rig.write(STEP, 0)
    assert rig.world.axis(axis)["steps_forward"] == 1


def test_an_axis_stops_at_its_end_and_counts_the_lost_steps(rig: Rig) -> None:
    axis = add_axis(rig, start_mm=-0.95)
    rig.start()
    rig.steps(STEP, DIR, 8, forward=False)
    state = rig.world.axis(axis)
    assert state["steps_lost"] == 3
    assert state["position_mm"] == pytest.approx(-1.0, abs=1e-9)


def test_the_switch_closes_at_its_position_and_opens_again(rig: Rig) -> None:
    add_axis(rig, start_mm=0.05, endstop_mm=0.0)
    rig.start()
    assert rig.read(ENDSTOP) == 0
    rig.steps(STEP, DIR, 5, forward=False)
    assert rig.read(ENDSTOP) == 1
    rig.steps(STEP, DIR, 1, forward=True)
    assert rig.read(ENDSTOP) == 0


def test_a_switch_at_the_far_end_closes_above_its_position(rig: Rig) -> None:
    add_axis(rig, start_mm=9.98, endstop_mm=10.0, endstop_at_max=True)
    rig.start()
    rig.steps(STEP, DIR, 1, forward=True)
    assert rig.read(ENDSTOP) == 0
    rig.steps(STEP, DIR, 2, forward=True)
    assert rig.read(ENDSTOP) == 1


def test_software_and_hardware_pwm_of_the_same_duty_drive_a_fan_alike(rig: Rig) -> None:
    soft = rig.world.add_fan(FAN, spin_up_s=0.2)
    hard = rig.world.add_fan(Pin(0, 7), spin_up_s=0.2)
    rig.start()
    rig.order(bytes([ord("p"), 7, 102]))  # 40 %
    for _ in range(150):  # 1.5 s of 10 ms cycles
        rig.write(FAN, 1)
        rig.run(0.00395)
        rig.write(FAN, 0)
        rig.run(0.00595)
    speed = rig.world.lib.world_fan_speed
    assert speed(rig.world.pointer, hard) == pytest.approx(0.4 * (1 - math.exp(-1.5 / 0.2)), abs=0.005)
    # a 10 ms cycle behind 0.2 s ripples by 0.4 * 10/200 = 0.02
    assert speed(rig.world.pointer, soft) == pytest.approx(speed(rig.world.pointer, hard), abs=0.02)


def test_a_bed_warms_by_its_power_and_its_thermistor_follows(rig: Rig) -> None:
    values = parameter_values("load", "bed", {"noise_lsb": 0.0})
    bed = rig.world.add_load(values, True, HEATER, SENSOR)
    rig.start()
    cold = rig.adc(SENSOR)
    rig.write(HEATER, 1)
    rig.run(30.0)
    warm_c = rig.world.lib.world_load_temperature(rig.world.pointer, bed)
    # 200 W into 520 J/K for 30 s is 11.5 K if nothing were lost and no heat stayed in the element
    assert 27.0 < warm_c < 35.0
    assert rig.adc(SENSOR) < cold - 50, "a warm NTC pulls its divider down"


def test_an_unconnected_adc_pin_reads_full_scale(rig: Rig) -> None:
    rig.start()
    assert rig.adc(Pin(0, 99)) == 4095


def test_a_chip_feels_its_own_temperature(rig: Rig) -> None:
    """1.395 V of 3.3 V at 25 degC and 4.2 mV less a kelvin: what the host's table has for a simulated chip."""
    rig.start()
    sensor = Pin(0, 254)
    assert rig.adc(sensor) == round(1.395 / 3.3 * 4095)
    for temp_c, code in ((85.0, (1.395 - 60 * 0.0042) / 3.3 * 4095), (1000.0, 0)):
        rig.world.set_chip_temperature(0, temp_c)
        assert rig.adc(sensor) == round(code)
    with pytest.raises(WorldError, match="no such MCU"):
        rig.world.set_chip_temperature(3, 25.0)


def test_the_bridge_heats_the_nozzle_with_the_power_of_its_phase(rig: Rig) -> None:
    nozzle = rig.world.add_nozzle(0, parameter_values("nozzle", "reference", {}))
    rig.start()
    phase = round(45000 * math.sqrt(0.1))  # 10 %: 300 degC after 6.2 s (reference plant)
    rig.order(bytes([ord("b"), phase & 255, phase >> 8]))
    rig.run(6.2)
    assert rig.world.lib.world_nozzle_temperature(rig.world.pointer, nozzle) == pytest.approx(300.0, abs=6.0)


def test_samples_carry_the_temperature_and_the_same_seed_the_same_noise(fake: Path) -> None:
    def codes(seed: int) -> bytes:
        rig = Rig(fake, seed)
        rig.world.add_nozzle(0, parameter_values("nozzle", "reference", {}))
        rig.start()
        rig.order(bytes([ord("b"), 2012 & 255, 2012 >> 8]))
        rig.run(0.01)
        return rig.order(bytes([ord("s"), 100]), reply=200)

    assert codes(5) == codes(5)
    assert codes(5) != codes(6)


def test_retracted_filament_comes_back_without_new_melt(rig: Rig) -> None:
    axis = rig.world.add_axis("E", STEP, DIR, 0.01)
    rig.world.add_nozzle(0, parameter_values("nozzle", "reference", {}), axis, filament_area_mm2=2.0)
    rig.start()

    def extruded() -> float:
        rig.run(0.005)
        return float(rig.world.figures()["extruded_mm3"])

    rig.steps(STEP, DIR, 50, forward=True)
    assert extruded() == pytest.approx(1.0, abs=1e-9)
    rig.steps(STEP, DIR, 40, forward=False)
    rig.steps(STEP, DIR, 40, forward=True)
    assert extruded() == pytest.approx(1.0, abs=1e-9)
    rig.steps(STEP, DIR, 10, forward=True)
    assert extruded() == pytest.approx(1.2, abs=1e-9)


def test_a_restarting_mcu_leaves_heater_and_bridge_off(rig: Rig) -> None:
    rig.world.add_load(parameter_values("load", "bed", {}), True, HEATER, SENSOR)
    nozzle = rig.world.add_nozzle(0, parameter_values("nozzle", "reference", {}))
    rig.start()
    rig.write(HEATER, 1)
    rig.order(bytes([ord("b"), 20000 & 255, 20000 >> 8]))
    rig.run(1.0)
    assert rig.order(b"R", reply=1) == b"B"
    temperature = rig.world.lib.world_nozzle_temperature
    before = temperature(rig.world.pointer, nozzle)
    rig.run(0.5)
    assert temperature(rig.world.pointer, nozzle) < before, "it cools from the moment of the reset"


def test_a_machine_that_cannot_be_is_refused_with_a_reason(rig: Rig) -> None:
    with pytest.raises(WorldError, match="pin"):
        rig.world.add_axis("X", Pin(0, 500), DIR, 0.01)
    rig.world.add_nozzle(0, parameter_values("nozzle", "reference", {}))
    with pytest.raises(WorldError, match="bridge"):
        rig.world.add_nozzle(0, parameter_values("nozzle", "reference", {}))
