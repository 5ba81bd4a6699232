"""The plant against the published tables and figures it was fitted to."""

from __future__ import annotations

import numpy as np
import pytest

import plant_tables as tables
from pure_harness import Plant


@pytest.mark.parametrize("model", [0, 1], ids=["phasor", "direct law"])
def test_table_1_is_met_within_4_units_rms(model):
    """4 units is 5 degC at low power; the paper's own regression leaves 4.5 to 4.8."""
    plant, table = tables.table1_errors(signal_model=model)
    difference = plant - table
    assert np.sqrt(np.mean(difference**2)) < 4.0
    assert np.abs(difference).max() < 6.0


@pytest.fixture(scope="module")
def induction_cooling():
    return tables.table5_times("induction")


def test_table_5_induction_column_within_2_s(induction_cooling):
    """2 s is what the stopwatch figures (whole seconds, one run) can carry."""
    for start, end, published_s, simulated_s in induction_cooling:
        assert simulated_s == pytest.approx(published_s, abs=2.0), (start, end)


def test_table_5_conventional_column_within_half_a_second_on_its_five_consistent_rows():
    """300 to 250 (34 s) and 250 to 50 (450 s) contradict the others: 250, 200, 150, 100, 50 in steps add to 510 s."""
    rows = {(a, b): (c, d) for a, b, c, d in tables.table5_times("conventional")}
    for key in ((250, 230), (250, 200), (200, 150), (150, 100), (100, 50)):
        published_s, simulated_s = rows[key]
        assert simulated_s == pytest.approx(published_s, abs=0.5), key
    published_sum = sum(rows[key][0] for key in ((250, 200), (200, 150), (150, 100), (100, 50)))
    assert published_sum == 510 and rows[(250, 50)][0] == 450


@pytest.mark.parametrize(("temp_c", "loss_w"), [(212, 3.9), (250, 4.7), (500, 11.0)])
def test_static_loss_within_10_percent(temp_c, loss_w):
    assert tables.hold(Plant(start_c=temp_c), temp_c) == pytest.approx(loss_w, rel=0.10)


@pytest.mark.parametrize(
    ("preset", "percent", "to_c", "seconds", "tolerance_s"),
    [("reference", 10, 300, 6.2, 0.1), ("reference", 90, 750, 5.7, 0.1), ("strong", 100, 300, 0.45, 0.05)],
)
def test_heating_up_takes_the_known_time(preset, percent, to_c, seconds, tolerance_s):
    """Tolerance: the figures' last digit; the strong preset's 0.45 s is 282 W into 0.9 g of steel, by hand 0.44 s."""
    assert tables.heat_up_s(preset, percent, to_c) == pytest.approx(seconds, abs=tolerance_s)


def test_extrusion_at_40_mm_s_cools_5_4_degrees_in_0_2_s():
    """Published: about 5 degC in 0.2 s at 440 degC and 40 mm/s. The flow that makes 5.4 degC of it is 6.0 mm^3/s with
    the power off at the same moment (0.15 mm^2 of bead); of the 5.4 degC the losses alone take 3.7."""
    plant = Plant(start_c=440)
    tables.hold(plant, 440)
    plant.phase(0)
    plant.inputs(flow_mm3_s=6.0)
    before_c = plant.read().skin_c
    plant.advance(0.2)
    assert before_c - plant.read().skin_c == pytest.approx(5.4, abs=0.1)


@pytest.mark.parametrize(("flow_mm3_s", "outlet_c"), [(5, 234), (25, 117)])
def test_melt_leaves_colder_at_high_flow(flow_mm3_s, outlet_c):
    """A wall held at 250 degC; figures of the fit, to their last digit and the bore's lag."""
    plant = Plant(start_c=250, mass_g=20, mass_factor=5, bore_tau_s=1e-3)
    plant.inputs(flow_mm3_s=flow_mm3_s)
    plant.advance(0.15)
    assert plant.read().melt_c == pytest.approx(outlet_c, abs=2)


@pytest.mark.parametrize(
    ("change", "value", "shift_c", "tolerance_c"),
    [("c1_factor", 1.001, -15, 2.5), ("frequency_ppm", 100, -3, 0.7), ("skew_ns", 1, 1.1, 0.1)],
)
def test_drifts_move_the_reading_as_known(change, value, shift_c, tolerance_c):
    """Known, at low power: C1 +0.1 % about -15 degC, 100 ppm of frequency about 3, 1 ns of skew about 1.1."""
    levels = []
    for changes in ({}, {change: value}):
        plant = Plant(start_c=250, **changes)
        plant.power(0.2)
        plant.sample(100)
        levels.append(plant.sample(65536).mean())
    assert (levels[1] - levels[0]) / 0.7997 == pytest.approx(shift_c, abs=tolerance_c)


def test_supply_voltage_scales_the_heat_to_the_power_of_one_and_a_half():
    powers = []
    for supply_v in (24.0, 12.0):
        plant = Plant(supply_v=supply_v)
        plant.phase(45000)
        powers.append(plant.read().power_w)
    assert powers[0] == pytest.approx(81.3)
    assert powers[1] / powers[0] == pytest.approx(0.5**1.5)


@pytest.mark.parametrize("preset", ["reference", "strong"])
def test_the_metal_never_gets_more_than_the_supply_gives(preset):
    plant = Plant(preset)
    for ticks in range(1, 45001, 250):
        plant.phase(ticks)
        out = plant.read()
        assert 0 < out.power_w <= out.electrical_w
    assert out.electrical_w == pytest.approx(329 if preset == "reference" else 336, abs=1)


@pytest.mark.parametrize("preset", ["reference", "strong"])
@pytest.mark.parametrize("factors", [(0.8, 1.2, 1.2), (1.2, 0.8, 0.8), (1.0, 1.0, 1.0)])
def test_heat_is_neither_made_nor_lost(preset, factors):
    """Put in = lost + carried off + stored; the tolerance is the midpoint rule's error, 1e-6 of the heat."""
    mass, loss, efficiency = factors
    plant = Plant(preset, mass_factor=mass, loss_factor=loss, efficiency_factor=efficiency)
    for ticks, flow, fan, seconds in ((20000, 0, 0, 3), (9000, 8, 1, 4), (0, 25, 1, 2), (14000, 0, 0.5, 3)):
        plant.phase(ticks)
        plant.inputs(flow_mm3_s=flow, fan=fan)
        plant.advance(seconds)
    balance = plant.balance()
    assert balance.lost_j > 1 and balance.melt_j > 1
    out_j = balance.lost_j + balance.melt_j + balance.stored_j
    assert out_j == pytest.approx(balance.metal_j, rel=1e-6)


def test_result_does_not_depend_on_the_callers_step():
    """0.27 ms as the simulator calls it, or 10 ms: the same within 5 mK (flow and fan change between)."""
    ends = []
    for step_s in (32 / 120e3, 10e-3):
        plant = Plant("strong")
        for ticks, flow in ((30000, 0), (10000, 10), (5000, 0)):
            plant.phase(ticks)
            plant.inputs(flow_mm3_s=flow, fan=0.5)
            for _ in range(round(0.4 / step_s)):
                plant.advance(step_s)
        ends.append(plant.read().skin_c)
    assert ends[0] == pytest.approx(ends[1], abs=5e-3)


def test_bore_lags_the_skin_by_its_time_constant():
    """On a ramp of r a first-order lag trails by r tau; 49 ms at the strong preset's rate."""
    plant = Plant("strong")
    plant.phase(20000)
    plant.advance(0.5)
    before_c = plant.read().skin_c
    plant.advance(0.01)
    out = plant.read()
    rate = (out.skin_c - before_c) / 0.01
    assert out.skin_c - out.bore_c == pytest.approx(rate * 0.049, rel=0.02)


def test_fan_adds_its_conductance():
    """5 mW/K at 230 K above the air is 1.15 W more to hold 250 degC."""
    still, blown = Plant(start_c=250), Plant(start_c=250)
    blown.inputs(fan=1.0)
    assert tables.hold(blown, 250) - tables.hold(still, 250) == pytest.approx(1.15, abs=0.02)


def test_heating_falls_above_the_curie_point_when_asked():
    plant = Plant("strong", start_c=900, curie_drop=0.6)
    plant.phase(45000)
    assert plant.read().power_w == pytest.approx(0.4 * 282, rel=0.01)
    cold = Plant("strong", start_c=300, curie_drop=0.6)
    cold.phase(45000)
    assert cold.read().power_w == pytest.approx(282, rel=0.01)
