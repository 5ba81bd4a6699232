"""Every fault shows: in the codes, in the heat, or in both; and can come and go while running."""

from __future__ import annotations

import numpy as np
import pytest

from pure_harness import Plant

NONE, NO_NOZZLE, COIL_BROKEN, BRIDGE_STUCK, SIGNAL_STUCK, SIGNAL_LOST = range(6)


@pytest.fixture
def running() -> Plant:
    plant = Plant(start_c=250)
    plant.power(10)
    plant.sample(200)
    return plant


def mean_after(plant: Plant, fault: int) -> float:
    plant.set_param("fault", fault)
    plant.sample(200)
    return float(plant.sample(4096).mean())


@pytest.mark.parametrize(
    ("fault", "heat_goes_on"),
    [
        (NO_NOZZLE, False),
        (COIL_BROKEN, False),
        (BRIDGE_STUCK, True),
        (SIGNAL_STUCK, True),
        (SIGNAL_LOST, True),
    ],
)
def test_fault_moves_the_codes_and_is_undone(running, fault, heat_goes_on):
    healthy = float(running.sample(4096).mean())
    running.set_param("fault_code", 900)
    broken = mean_after(running, fault)
    assert abs(broken - healthy) > 8, "8 LSB is 80 sigma of such a mean"
    assert (running.read().power_w > 1) == heat_goes_on
    assert mean_after(running, NONE) == pytest.approx(healthy, abs=0.5)


def test_without_a_nozzle_the_tank_is_far_off_resonance(running):
    assert mean_after(running, NO_NOZZLE) > 256 + 700, "above anything a nozzle below 750 degC gives"


@pytest.mark.parametrize("fault", [COIL_BROKEN, SIGNAL_LOST])
def test_a_lost_signal_reads_as_error_0_which_looks_cold(running, fault):
    """The dangerous kind: error 0 is 25 degC, a controller would heat. Guard rows (low limit) are for this."""
    assert mean_after(running, fault) == pytest.approx(256, abs=0.2)


def test_a_stuck_bridge_heats_whatever_is_commanded(running):
    running.set_param("fault_phase_ticks", 30000)
    running.set_param("fault", BRIDGE_STUCK)
    running.phase(0)
    before_c = running.read().skin_c
    running.advance(0.5)
    assert running.read().skin_c > before_c + 20
    stuck = running.sample(4096).mean()
    healthy = Plant(start_c=running.read().skin_c)
    healthy.phase(30000)
    healthy.sample(200)
    assert stuck == pytest.approx(healthy.sample(4096).mean(), abs=0.2)


@pytest.mark.parametrize(("code", "expected"), [(0, 0), (4095, 4095), (1234, 1234)])
def test_a_stuck_signal_is_one_code(running, code, expected):
    running.set_param("fault_code", code)
    running.set_param("fault", SIGNAL_STUCK)
    assert set(running.sample(1000).tolist()) == {expected}


def test_a_stuck_signal_without_a_code_keeps_the_last_one(running):
    last = int(running.sample(32)[-1])
    running.set_param("fault", SIGNAL_STUCK)
    running.power(50)
    assert set(np.concatenate([running.sample(32) for _ in range(10)]).tolist()) == {last}


def test_a_parameter_can_drift_while_running(running):
    before = float(running.sample(65536).mean())
    running.set_param("c1_factor", 1.001)
    running.sample(200)
    assert running.sample(65536).mean() < before - 5


def test_unknown_parameters_are_refused():
    with pytest.raises(KeyError):
        Plant().set_param("no_such", 1)
    assert Plant().lib.plant_param_index(b"no_such") == -1


def flow_after(plant: Plant, fed_mm3_s: float = 5.0) -> float:
    plant.inputs(flow_mm3_s=fed_mm3_s)
    plant.advance(0.2)
    return float(plant.read().flow_mm3_s)


def test_lost_filament_and_a_closed_hole_pass_no_flow(running):
    assert flow_after(running) == pytest.approx(5.0, rel=1e-3)
    running.set_param("flow_share", 0.7)
    assert flow_after(running) == pytest.approx(3.5, rel=1e-3)
    running.set_param("hole_mm", 0.0)
    assert flow_after(running) == pytest.approx(0.0, abs=1e-3)


def test_a_drive_slips_in_a_clog_and_less_in_a_hotter_one(running):
    running.set_param("hole_mm", 0.1)
    assert flow_after(running) == pytest.approx(5.0, rel=1e-3), (
        "without a limit of force the drive never slips"
    )
    running.set_param("drive_force_n", 60.0)
    hot = flow_after(running)
    cold = Plant(start_c=200, hole_mm=0.1, drive_force_n=60.0)
    assert 0.0 < flow_after(cold) < hot < 5.0
