"""What a real machine adds to the simulated nozzle, effect by effect, against closed formulas and published sizes.

Signal units per 0.1 % of a component and per °C at 250 °C are the phasor's, computed here once more in complex numbers.
"""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest

from pure_harness import Plant

UNITS_PER_LSB = 0.01  # so that rounding is nothing
ZERO = 2000.0
DRIVES = (0.2, 10.0, 20.0, 50.0, 100.0)  # percent
HELD_C = 250.0


def quiet(preset: str = "reference", **changes: float) -> Plant:
    values = {"noise_lsb": 0.0, "units_per_lsb": UNITS_PER_LSB, "adc_zero": ZERO, "adc_max": 65535.0}
    return Plant(preset, **{"start_c": HELD_C, **values, **changes})


def level(plant: Plant) -> float:
    """Signal units now."""
    return (float(plant.sample(1)[0]) - ZERO) * UNITS_PER_LSB


def signal(percent: float, **changes: float) -> float:
    plant = quiet(**changes)
    plant.power(percent)
    plant.sample(300)
    return level(plant)


def shift(percent: float, **changes: float) -> float:
    """What the changes do to the signal, units."""
    start_c = changes.get("start_c", HELD_C)
    return signal(percent, **changes) - signal(percent, start_c=start_c)


def per_k(percent: float, temp_c: float = HELD_C) -> float:
    return (signal(percent, start_c=temp_c + 5.0) - signal(percent, start_c=temp_c - 5.0)) / 10.0


def phasor_units(percent: float, l1: float = 1.0, l2: float = 1.0, c1: float = 1.0, r: float = 1.0) -> float:
    """The signal of the LCL tank at HELD_C with components scaled."""
    w, turn = 2.0 * math.pi * 120e3, 0.5 * math.pi * (percent / 100.0) ** 0.5
    current = 0j
    for _ in range(30):
        x = abs(current) / 39.7
        effect = math.exp(-0.457 * x**2 - 0.599 * x**8)
        coil_h = 3.6e-6 * (1.0 - 1e-4 * effect * (HELD_C - 390.0)) * l1
        k = 1.0 - w * w * 7.138e-6 * l2 * 0.7351e-6 * c1
        current = (
            4.0 / math.pi * 24.0 * math.sin(turn) / (0.3878 * r * k + 1j * w * (7.138e-6 * l2 + coil_h * k))
        )
    return 20.136 * math.degrees(cmath.phase(-current))


@pytest.mark.parametrize("percent", DRIVES)
@pytest.mark.parametrize(
    ("changes", "scaled"),
    [
        ({"c1_ppm_k": 30.0, "board_c": 55.0}, {"c1": 1.0009}),  # C0G, 30 K
        ({"c1_ppm_k": -250.0, "board_c": 55.0}, {"c1": 0.9925}),  # film, 30 K
        ({"l2_ppm_k": 100.0, "board_c": 55.0}, {"l2": 1.003}),
    ],
)
def test_parts_detune_the_tank_with_their_temperature(percent, changes, scaled):
    """To 0.02 units: rounding of the code and the fixed point of the current."""
    expected = phasor_units(percent, **scaled) - phasor_units(percent)
    assert shift(percent, **changes) == pytest.approx(expected, abs=0.02)


def test_sizes_in_degrees_are_those_of_a_real_machine():
    """C0G 14 °C, film 115 °C (small drive); 1 ns 1.1 °C; 1 % of the supply 0.3 °C at 10 %, 8 °C at full drive."""
    small_k = per_k(0.2)
    assert shift(0.2, c1_ppm_k=-30.0, board_c=55.0) / small_k == pytest.approx(14.0, abs=0.5)
    assert shift(0.2, c1_ppm_k=-250.0, board_c=55.0) / small_k == pytest.approx(115.0, abs=2.0)
    assert shift(0.2, delay_ns_k=0.1, board_c=35.0) / small_k == pytest.approx(1.1, abs=0.02)
    assert shift(10.0, supply_v=24.24) / per_k(10.0) == pytest.approx(0.3, abs=0.05)
    assert shift(100.0, supply_v=24.24) / per_k(100.0) == pytest.approx(8.0, abs=0.2)


@pytest.mark.parametrize(("name", "scale", "size_c"), [("l1", 3.6e3, 14.0), ("l2", 7.138e3, 3.5)])
def test_cable_adds_inductance_with_the_place_of_the_head(name, scale, size_c):
    """5 nH read 14 °C beside the coil and 3.5 °C beside L2, with the sign of the head's side."""
    plant = quiet(**{f"cable_{name}_nh": 5.0})
    plant.power(0.2)
    levels = []
    for place in (0.0, 1.0, -1.0):
        plant.lib.plant_set_head(plant.c, place, 0.0)
        plant.sample(300)
        levels.append(level(plant))
    l1_share = 3.6e3 * 1.014 / scale if name == "l1" else 1.0  # nH are added to the coil as it is at HELD_C
    expected = phasor_units(0.2, **{name: 1.0 + 5.0 / scale / l1_share}) - phasor_units(0.2)
    assert levels[1] - levels[0] == pytest.approx(expected, abs=0.05)
    assert levels[2] - levels[0] == pytest.approx(-expected, rel=0.02)
    assert abs(expected / per_k(0.2)) == pytest.approx(size_c, rel=0.1)


def test_cold_start_warms_the_coil_by_its_own_loss_and_that_detunes():
    """I^2 R of 0.15 ohm at 39.7 A is 118 W: 20 to 80 K for 8 to 2 J/K at full drive to 250 °C."""
    for coil_j_k, low_k, high_k in ((8.0, 17.0, 22.0), (2.0, 70.0, 90.0)):
        plant = quiet(start_c=20.0, coil_j_k=coil_j_k)
        plant.power(100.0)
        while plant.read().skin_c < HELD_C:
            plant.advance(2e-3)
        assert low_k < plant.read().coil_c - 20.0 < high_k, coil_j_k


def test_warm_copper_adds_resistance_and_expands():
    """+40 K: 0.39 %/K of 0.15 ohm, 17 ppm/K of L1: 10 °C and 7 °C at small drive."""
    plant = quiet(coil_j_k=1000.0, ambient_c=65.0)
    plant.power(0.2)
    plant.sample(300)
    r, l1 = 1.0 + 0.15 * 3.9e-3 * 40.0 / 0.3878, 1.0 + 17e-6 * 40.0
    expected = phasor_units(0.2, r=r, l1=l1) - phasor_units(0.2)
    assert level(plant) - signal(0.2) == pytest.approx(expected, abs=0.05)
    small_k = per_k(0.2)
    assert abs(phasor_units(0.2, r=r) - phasor_units(0.2)) / small_k == pytest.approx(9.0, abs=1.5)
    assert abs(phasor_units(0.2, l1=l1) - phasor_units(0.2)) / small_k == pytest.approx(7.0, abs=0.5)


def test_capacitor_and_choke_warm_by_thirty_kelvin_at_full_drive():
    for part in ("cap", "choke"):
        plant = quiet(heat_w=5.0, **{f"{part}_j_k": 1.0})
        plant.power(100.0)
        for _ in range(20):
            plant.advance(10.0)
        warm_k = getattr(plant.c.effects, f"{part}_c") - 25.0
        assert warm_k == pytest.approx(30.0, abs=6.0), part


def test_resistance_of_the_steel_rises_with_its_temperature_and_less_in_the_field():
    """3e-4/K from 250 to 400 °C are 4.5 %: 1.1 units a percent at small drive (phasor), by the table within a tenth."""
    for slope, share in ((3e-4, 1.0), (6e-4, 2.0)):
        expected = share * 0.0463 * 100.0
        hot = {"start_c": 400.0}
        one_percent = signal(0.2, r_ohm=0.3878 * 1.01, **hot) - signal(0.2, **hot)
        assert shift(0.2, r_rise_per_k=slope, **hot) / one_percent == pytest.approx(expected, rel=0.1)


def test_climb_at_full_drive_sees_the_resistance_by_tens_of_degrees():
    """56 °C of the reading at 3e-4/K on the way up, within a third; little where it is held."""
    climb_c = shift(100.0, start_c=100.0, r_rise_per_k=3e-4) / per_k(100.0, 100.0)
    assert climb_c == pytest.approx(56.0, rel=0.33)
    assert abs(shift(10.0, r_rise_per_k=3e-4) / per_k(10.0)) < 0.6


def test_inductance_leaves_the_straight_line_toward_the_curie_point():
    def curve_c(temp_c: float) -> float:
        return shift(0.2, start_c=temp_c, l1_curve=0.01) / per_k(0.2)

    assert abs(curve_c(25.0)) < 0.1
    assert abs(curve_c(250.0)) < 4.0
    assert curve_c(650.0) > 50.0


def test_error_of_a_machine_is_smooth_over_the_drive_with_the_rms_asked_for():
    ticks = np.linspace(1000.0, 45000.0, 89)

    def curve(number: float) -> np.ndarray:
        return np.array(
            [shift((t / 450.0) ** 2 / 100.0, signal_error=0.3, machine_number=number) for t in ticks]
        )

    first, other = curve(1.0), curve(2.0)
    assert np.sqrt((first**2).mean()) == pytest.approx(0.3, rel=0.1)
    assert abs(first.mean()) < 0.05
    assert np.abs(np.diff(first)).max() < 0.1, (
        "half a thousand ticks change it by less than a third of its rms"
    )
    assert np.abs(first - other).max() > 0.2


# --- supply -----------------------------------------------------------------------------------------------------------


def test_bus_falls_behind_the_resistance_with_the_capacitor_s_time_constant():
    """329 W from 24 V are 13.7 A: 0.41 V over 30 mohm (the source's own drop neglected), in 66 us with 2200 uF."""
    plant = quiet(supply_ohm=0.03, bus_uf=2200.0)
    plant.power(100.0)
    plant.advance(66e-6)
    assert 24.0 - plant.read().supply_v == pytest.approx(0.411 * (1.0 - math.exp(-1.0)), rel=0.02)
    plant.advance(2e-3)
    assert 24.0 - plant.read().supply_v == pytest.approx(0.411, rel=0.02)
    assert plant.read().power_w == pytest.approx(81.3 * (1.0 - 0.411 / 24.0) ** 1.5, rel=1e-3)


def test_sensor_of_the_supply_reads_bus_gain_and_noise():
    plant = quiet(supply_v=24.5, vdc_gain=1.01, vdc_noise_lsb=2.0, adc_max=4095.0)
    codes = np.array([4095.0 * plant.lib.effects_bus_code(plant.c, 36.0) for _ in range(2000)])
    assert codes.mean() / 4095.0 * 36.0 == pytest.approx(24.745, abs=0.002)
    assert codes.std() == pytest.approx(2.0, rel=0.1)


# --- wall and tip -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("preset", "look_k", "steady_k"), [("reference", 1.1, 6.0), ("strong", 3.7, 20.0)])
def test_skin_stands_above_the_mean_of_the_wall_under_power(preset, look_k, steady_k):
    """A slab heated on one side: q w/3k in the end, and 2 q sqrt(alpha t/pi)/k 0.3 ms after the step."""
    plant = quiet(preset, wall_k_w=0.072)
    plant.power(100.0)
    for _ in range(3):
        plant.advance(1e-4)
    now = plant.read()
    slab_k = 3.0 * 0.072 * now.power_w * 2.0 * math.sqrt(3e-4 / 0.098 / math.pi)
    assert now.skin_c - now.mean_c == pytest.approx(slab_k, rel=0.08)
    assert now.skin_c - now.mean_c == pytest.approx(look_k, rel=0.1)
    plant.advance(0.2)
    now = plant.read()
    assert now.skin_c - now.mean_c == pytest.approx(steady_k, rel=0.03)


def test_tip_is_colder_than_the_coil_zone_by_the_heat_into_the_melt():
    """11 °C at 3.5 W, and the melt leaves with the tip's temperature; the heat is still in balance."""
    plant = quiet(tip_k_w=3.1, start_c=250.0)
    plant.inputs(12.0)
    plant.advance(3.0)
    now = plant.read()
    melt_w = 2.1e-3 * 12.0 * (now.melt_c - 25.0)
    assert now.bore_c - now.tip_c == pytest.approx(3.1 * melt_w, rel=0.05)
    heat = plant.balance()
    assert heat.metal_j - heat.lost_j - heat.melt_j - heat.stored_j == pytest.approx(0.0, abs=0.05)


# --- movement, disturbances -------------------------------------------------------------------------------------------


def run(plant: Plant, seconds: float) -> np.ndarray:
    """Codes in half buffers, as the world takes them."""
    chunks = []
    for _ in range(round(seconds * 120e3 / 32)):
        chunks.append(plant.sample(32))
        plant.advance(32 / 120e3)
    return np.concatenate(chunks).astype(float)


def held(**changes: float) -> Plant:
    """A plant at rest: no drive-dependent drift, since it neither cools nor heats by more than 0.1 K in a second."""
    plant = quiet(mass_g=20.0, mass_factor=5.0, second_j_k=100.0, ambient_c=HELD_C, heat_w=0.0, **changes)
    plant.power(0.2)
    plant.sample(300)
    return plant


def test_ten_micrometres_in_the_coil_read_two_degrees():
    codes = run(held(move_um=10.0, move_hz=20.0), 0.2) * UNITS_PER_LSB
    swing_c = (codes.max() - codes.min()) / 2.0 / per_k(0.2)
    assert swing_c == pytest.approx(2.0, rel=0.1)
    spectrum = np.abs(np.fft.rfft(codes - codes.mean()))
    assert np.argmax(spectrum) / 0.2 == pytest.approx(20.0, abs=5.0)


def test_nozzle_shakes_with_the_full_steps_of_the_motors():
    plant = held(move_step_um=10.0)
    levels = []
    for way_mm in (0.0, 0.05, 0.1, 0.15, 0.2):
        plant.lib.plant_set_head(plant.c, 0.0, way_mm)
        levels.append(level(plant))
    assert levels[1] - levels[0] == pytest.approx(-(levels[3] - levels[0]), rel=0.02)
    assert abs(levels[1] - levels[0]) / per_k(0.2) == pytest.approx(2.0, rel=0.1)
    assert levels[2] == pytest.approx(levels[0], abs=0.02) and levels[4] == pytest.approx(levels[0], abs=0.02)


def test_random_movement_has_its_rms():
    codes = run(held(move_random_um=10.0, move_random_hz=200.0), 2.0) * UNITS_PER_LSB
    assert codes.std() / per_k(0.2) == pytest.approx(2.0, rel=0.15)


def test_interference_is_a_sine_at_the_beat():
    codes = run(held(emi_lsb=500.0, emi_hz=50.0), 0.2)
    assert (codes.max() - codes.min()) / 2.0 == pytest.approx(500.0, rel=0.01)
    assert np.argmax(np.abs(np.fft.rfft(codes - codes.mean()))) / 0.2 == pytest.approx(50.0, abs=0.1)


def test_broad_interference_lies_about_the_beat():
    codes = run(held(emi_broad_lsb=500.0, emi_hz=400.0, emi_broad_hz=20.0), 4.0)
    assert codes.std() == pytest.approx(500.0, rel=0.15)
    power = np.abs(np.fft.rfft(codes - codes.mean())) ** 2
    hertz = np.fft.rfftfreq(len(codes), 1 / 120e3)
    assert power[np.abs(hertz - 400.0) < 80.0].sum() / power.sum() > 0.75


def test_coloured_noise_has_its_rms_and_bandwidth():
    """Correlation of a first-order filter falls to 1/e after 1/(2 pi f). 4 s hold some 500 independent values."""
    codes = run(held(coloured_lsb=300.0, coloured_hz=20.0), 4.0)
    codes -= codes.mean()
    assert codes.std() == pytest.approx(300.0, rel=0.15)
    lag = round(120e3 / (2.0 * math.pi * 20.0))
    assert (codes[:-lag] * codes[lag:]).mean() / codes.var() == pytest.approx(math.exp(-1.0), abs=0.12)


def test_preset_real_has_every_effect_and_the_others_none():
    """An effect is on where its first parameter is not 0."""
    rows = {row.name: row for row in Plant().params()}
    switches = [name for name, row in rows.items() if row.reference == 0.0 != row.real]
    assert len(switches) >= 22
    for name in switches:
        assert rows[name].strong == 0.0, name
    effects = quiet().c.effects
    assert not any((effects.wall, effects.tip, effects.parts, effects.bus, effects.moves, effects.noisy))
