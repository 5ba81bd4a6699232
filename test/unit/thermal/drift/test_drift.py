"""The drift observer, the nozzle at rest and the table beside the tank law, each by itself."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from thermal.drift import observer
from thermal.drift.observer import AMBIENT, COUNT, DRIFT, SUPPLY, DriftParameters
from thermal.drift.rest import Rest
from thermal.sensing import laws

LAW = laws.TankLaw(g=1160.0, t0=390.0, w=1440.0, delta=0.0, b=0.457, q=0.6, c=0.0, d=313.9, m=1.0)
WEAK, FULL = 2012.0, 45000.0
TAU_S, HEAT_J_K = 50.0, 0.414


def added_c(drift_c: float, supply: float, temp_c: float) -> float:
    x = [0.0] * COUNT
    x[DRIFT], x[SUPPLY] = drift_c, supply
    return observer.added_c(LAW, 0.0, x, temp_c, FULL, WEAK, 1.0)


def climbed(drift_c: float, supply: float, cold_sigma_c: float) -> observer.DriftState:
    """After a zero at rest and looks in a climb to 250 degC."""
    state = observer.fresh(DriftParameters())
    observer.cold_zero(state, drift_c, cold_sigma_c)
    for temp_c in range(30, 260, 10):
        observer.looks(
            DriftParameters(),
            state,
            LAW,
            0.0,
            added_c(drift_c, supply, temp_c),
            1.0,
            temp_c=temp_c,
            lever=1.0,
            strong=FULL,
            weak=WEAK,
            supply=1.0,
        )
    return state


def test_a_detuned_tank_adds_nearly_twice_its_drift_at_full_drive_and_a_supply_less_the_hotter_it_is() -> (
    None
):
    """docs/theory/Induction.md: C1 +0.1 % reads 15 degC at the sensing phase and 44 at full drive."""
    assert added_c(15.0, 0.0, 250.0) == pytest.approx(28.5, abs=1.5)
    assert added_c(0.0, 0.01, 20.0) > 2.0 * added_c(0.0, 0.01, 250.0) > 10.0


@pytest.mark.parametrize(("drift_c", "supply"), [(0.0, 0.03), (15.0, 0.0), (-15.0, -0.03)])
def test_the_climb_separates_supply_from_detuning(drift_c: float, supply: float) -> None:
    state = climbed(drift_c, supply, 6.0)
    assert abs(state.drift_c - drift_c) < 2.0 * state.sigma_c < 12.0
    assert state.x[SUPPLY] == pytest.approx(supply, abs=0.01)


def test_a_repeated_zero_does_not_average_the_room_away() -> None:
    state = observer.fresh(DriftParameters())
    for _ in range(100):
        observer.cold_zero(state, 10.0, 0.5)
    assert state.sigma_c > 0.9 * DriftParameters().ambient_c
    assert state.p[AMBIENT][AMBIENT] > 0.0


def test_a_look_that_fits_nothing_is_the_laws_and_leaves_the_zero_alone() -> None:
    state = climbed(0.0, 0.0, 1.0)
    sigma_c = state.sigma_c
    observer.looks(
        DriftParameters(),
        state,
        LAW,
        0.0,
        250.0,
        1.0,
        temp_c=250.0,
        lever=1.0,
        strong=FULL,
        weak=WEAK,
        supply=1.0,
    )
    assert abs(state.drift_c) < sigma_c


@pytest.mark.parametrize("excess_c", [0.0, 8.0, 60.0])
def test_the_slope_of_the_reading_shows_how_warm_a_nozzle_at_rest_is(excess_c: float) -> None:
    rng, rest = random.Random(4), Rest()
    for i in range(41):
        rest.note(0.5 * i, 35.0 + excess_c * math.exp(-0.5 * i / TAU_S) + rng.gauss(0.0, 0.1), 0.1, 0.0)
    found_c, sigma_c = rest.excess_c(TAU_S, HEAT_J_K, 20.0)
    middle_c = excess_c * math.exp(-10.0 / TAU_S)
    assert abs(found_c - middle_c) < 2.0 * sigma_c < 3.0 + middle_c


@pytest.mark.parametrize("hz", [0.3, 2.0, 10.0])
def test_a_swing_of_the_reading_is_no_warm_nozzle(hz: float) -> None:
    """Half a second of a sine of 0.25 degC has slopes that many degrees above the room would have."""
    rest = Rest()
    for i in range(60):
        rest.note(0.01 * i, 20.0 + 0.25 * math.sin(2.0 * math.pi * hz * 0.01 * i), 0.1, 0.0)
    found_c, sigma_c = rest.excess_c(TAU_S, HEAT_J_K, 20.0)
    assert found_c <= sigma_c <= 1.0
    assert rest.is_still()


def test_readings_that_swing_do_not_agree() -> None:
    rest = Rest()
    for i in range(60):
        rest.note(0.01 * i, 10.0 + 4.0 * math.sin(2.0 * math.pi * 2.0 * 0.01 * i), 0.1, 0.0)
    assert not rest.is_still()


def test_the_heat_of_the_pulses_is_no_rest_of_a_colder_nozzle() -> None:
    rest = Rest()
    for i in range(41):
        rest.note(0.1 * i, 20.0 + 0.1 * i * 0.03 / HEAT_J_K, 0.1, 0.003)
    found_c, sigma_c = rest.excess_c(TAU_S, HEAT_J_K, 20.0)
    assert abs(found_c) < 1.0 and sigma_c < 3.0


TABLE = laws.LawTable(
    (2012.0, 20125.0, 45000.0),
    (20.0, 150.0, 300.0),
    ((1.0, -2.0, 3.0), (0.0, 5.0, -4.0), (60.0, 20.0, -30.0)),
    (0.0, 1.0, 30.0),
)
TABLED = replace(LAW, table=TABLE)


@pytest.mark.parametrize("phase", [2012.0, 9000.0, 31820.0, 45000.0])
@pytest.mark.parametrize("temp_c", [-40.0, 20.0, 149.0, 260.0, 400.0])
def test_a_law_with_a_table_inverts_what_it_predicts(phase: float, temp_c: float) -> None:
    error = TABLED.error(temp_c, phase)
    assert TABLED.invert(error, phase)[0] == pytest.approx(temp_c, abs=1e-6)
    slope = (TABLED.invert(error + 1e-4, phase)[0] - temp_c) / 1e-4
    assert TABLED.invert(error, phase)[1] == pytest.approx(slope, rel=1e-2)
    assert TABLED.rezeroed(temp_c + 5.0, error, phase).invert(error, phase)[0] == pytest.approx(
        temp_c + 5.0, abs=1e-6
    )


def test_a_table_gives_at_its_points_what_it_says() -> None:
    for phase, row in zip(TABLE.level_ticks, TABLE.added_c, strict=True):
        for node_c, added in zip(TABLE.node_c, row, strict=True):
            assert TABLED.invert(LAW.error(node_c, phase), phase)[0] == pytest.approx(
                node_c + added, abs=1e-6
            )


def test_a_table_survives_the_config_and_one_that_makes_no_sense_is_refused() -> None:
    assert laws.LawTable.of_rows(TABLE.rows()) == TABLE
    assert TABLE.trusted_ticks() == 20125.0
    rows = TABLE.rows()
    for bad in (
        rows[:2],
        [*rows[:3], rows[3][:-1]],
        [rows[0], rows[2], rows[1]],
        [rows[0], (2012.0, 0.0, 400.0, 0.0, 0.0), *rows[2:]],
    ):
        with pytest.raises(ValueError):
            laws.LawTable.of_rows(bad)
