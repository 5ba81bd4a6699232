"""Signal units to temperature: all laws invert exactly, Table 1 comes back, nonsense is invalid."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chain_rig import estimate, of_block
from thermal.records import SampleBlock
from thermal.sensing import block_temperature, blocks, features, guard_limits, laws

TABLE1 = Path(__file__).parents[2] / "data" / "oskolkov2021_table1.csv"
LAWS = [laws.ExpLaw(), laws.Eq5Law(), laws.TankLaw()]
phases = st.integers(block_temperature.SENSING_PHASE_TICKS, 45000)
temps = st.floats(-15.0, 750.0)


def read_table() -> list[tuple[float, float, float]]:
    """(power %, degC, error) of Oskolkov 2021, Table 1."""
    with TABLE1.open() as f:
        rows = csv.DictReader(line for line in f if not line.startswith("#"))
        return [(float(r["power_pct"]), float(r["temp_c"]), float(r["error"])) for r in rows]


@pytest.mark.parametrize("law", LAWS, ids=["exp", "eq5", "tank"])
@given(temp=temps, phase=phases)
def test_inversion_is_the_inverse(law: laws.Law, temp: float, phase: int) -> None:
    parameters = block_temperature.EstimatorParameters(law)
    got = estimate(parameters, law.error(temp, phase), phase)
    assert got.valid
    assert got.temp_c == pytest.approx(temp, abs=1e-6)  # rounding only


@pytest.mark.parametrize("law", LAWS, ids=["exp", "eq5", "tank"])
@given(temp=st.floats(50.0, 500.0), phase=phases)
def test_derivative_and_sigma_follow_the_slope(law: laws.Law, temp: float, phase: int) -> None:
    parameters = block_temperature.EstimatorParameters(law)
    error = law.error(temp, phase)
    got = estimate(parameters, error, phase)
    above = estimate(parameters, error + 0.05, phase)
    below = estimate(parameters, error - 0.05, phase)
    assert (above.temp_c - below.temp_c) / 0.1 == pytest.approx(got.dtemp_derror, rel=1e-6)
    assert got.sigma_noise_c == pytest.approx(0.03 * got.dtemp_derror)
    assert got.sigma_c == pytest.approx(math.hypot(0.03, law.residual_units) * got.dtemp_derror)


def residuals(law: laws.Law, power_max: float, low_c: float, high_c: float) -> list[float]:
    parameters = block_temperature.EstimatorParameters(law)
    found = []
    for power, temp, error in read_table():
        if power <= power_max and low_c <= temp <= high_c:
            got = estimate(parameters, error, round(45000 * math.sqrt(power / 100)))
            found.append(got.temp_c - temp)
    return found


def test_exp_law_gives_table_1_back_at_low_power() -> None:
    errors = residuals(laws.ExpLaw(), 20.0, 25.0, 500.0)
    assert len(errors) == 18
    # Figures of the fit: max 2.5, rms 1.3 degC at up to 20 % power, 25..500 degC; a tenth for rounded table values.
    assert max(abs(e) for e in errors) < 2.6
    assert math.sqrt(sum(e * e for e in errors) / len(errors)) < 1.4


def test_paper_law_is_as_far_off_as_its_residual_says() -> None:
    errors = residuals(laws.Eq5Law(), 100.0, 50.0, 350.0)
    # Computed from Table 1 and Table 2: max 15.5, rms 7.0 degC. It must not turn out better by accident.
    assert max(abs(e) for e in errors) == pytest.approx(15.5, abs=0.5)
    assert math.sqrt(sum(e * e for e in errors) / len(errors)) == pytest.approx(7.0, abs=0.4)


@pytest.mark.parametrize("law", LAWS, ids=["exp", "eq5", "tank"])
@given(error=st.floats(-5000.0, 5000.0), phase=st.integers(0, 45000))
def test_an_impossible_signal_is_never_a_number(law: laws.Law, error: float, phase: int) -> None:
    parameters = block_temperature.EstimatorParameters(law)
    got = estimate(parameters, error, phase)
    if got.valid:
        assert parameters.temp_low_c <= got.temp_c <= parameters.temp_high_c
        assert phase >= block_temperature.SENSING_PHASE_TICKS
        assert got.sigma_c > 0.0
    else:
        assert math.isnan(got.temp_c)
        assert got.reason


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"phase_ticks": 0}, "bridge off"),
        ({"max_raw": 4095}, "signal clipped"),
        ({"min_raw": 0}, "signal clipped"),
        ({"lost": 1}, "samples lost"),
        ({"phase_ticks": 1000}, "too little excitation"),
        ({"mean_raw": 3000.0}, "signal far above any nozzle's: is the nozzle missing from the coil?"),
        (
            {"mean_raw": 100.0},
            "outside the range of the sensing law: wrong nozzle, or its thermometer is not calibrated?",
        ),
    ],
)
def test_a_block_that_cannot_be_used_says_why(change: dict[str, float], reason: str) -> None:
    fields = {
        "sequence": 0,
        "clock": 0,
        "time_s": 0.0,
        "duration_s": 0.0085,
        "count": 1024,
        "mean_raw": 450.0,
    }
    fields |= {"min_raw": 446, "max_raw": 454, "phase_ticks": 8000, "discarded": 0, "lost": 0} | change
    block = SampleBlock(**fields)  # type: ignore[arg-type]
    got = of_block(block_temperature.EstimatorParameters(laws.ExpLaw()), features.FeatureParameters(), block)
    assert (got.valid, got.reason) == (False, reason)


def test_front_end_scale_and_count_set_error_and_noise() -> None:
    block = SampleBlock(0, 0, 0.0, 0.001, 100, 300.0, 290, 310, 9000, 0, 0)
    (got,) = features.extract(features.FeatureParameters(256.0, 6.4, 1.0), blocks.Blocks.of([block]))
    assert got.signal_units == pytest.approx(44.0 * 6.4)
    assert got.noise_units == pytest.approx(6.4 * math.sqrt((1.0 + 1.0 / 12.0) / 100))
    assert got.power_fraction == pytest.approx(0.04)


def test_blocks_of_different_phase_agree_after_conversion() -> None:
    """Each block with its own phase: the raw errors differ by 60 units, the temperatures do not."""
    law = laws.ExpLaw()
    parameters = block_temperature.EstimatorParameters(law)
    errors = [law.error(250.0, phase) for phase in (2012, 20125)]
    assert abs(errors[0] - errors[1]) > 30.0
    temps = [estimate(parameters, e, p).temp_c for e, p in zip(errors, (2012, 20125), strict=True)]
    assert temps == pytest.approx([250.0, 250.0], abs=1e-6)


@pytest.mark.parametrize("law", LAWS, ids=["exp", "eq5", "tank"])
def test_guard_limits_hold_every_healthy_reading_at_every_phase(law: laws.Law) -> None:
    front = features.FeatureParameters()
    rows = guard_limits.guard_limits(law, front, -60.0, 390.0)
    assert len(rows) <= 12  # what the firmware's guard stores
    assert [r.phase_ticks for r in rows] == sorted({r.phase_ticks for r in rows})
    assert rows[0].phase_ticks == block_temperature.SENSING_PHASE_TICKS
    for phase in range(block_temperature.SENSING_PHASE_TICKS, 45001, 97):
        row = [r for r in rows if r.phase_ticks <= phase][-1]
        for temp in (-60.0, 20.0, 250.0, 390.0):
            raw = front.adc_zero_raw + law.error(temp, phase)
            assert row.low_raw <= raw <= row.high_raw


def test_guard_trips_well_above_the_limit_at_low_power() -> None:
    law = laws.ExpLaw()
    row = guard_limits.guard_limits(law, features.FeatureParameters(), -60.0, 390.0)[0]
    # A row serves phases from 0.2 to 5 % power; over those the law's slope falls by 5 %: 390 degC may read as 415.
    assert 256.0 + law.error(415.0, 2012) > row.high_raw


def test_the_ceiling_follows_the_correction_of_the_law() -> None:
    """C1 -0.1 % reads 15 degC higher at the sensing phase and 44 at full drive."""
    law, front = laws.TankLaw(), features.FeatureParameters()
    rows = tuple(guard_limits.guard_limits(law, front, -150.0, 340.0))
    ceiling = guard_limits.Ceiling(20125, law, front, rows, 40.0)
    assert ceiling.share(200.0, -15.0) < ceiling.share(200.0) < ceiling.share(200.0, 15.0) < 0xFFFF


def test_guard_limits_refuse_a_front_end_that_cannot_show_them() -> None:
    with pytest.raises(ValueError, match="cannot show"):
        guard_limits.guard_limits(laws.ExpLaw(), features.FeatureParameters(-4000.0), -60.0, 390.0)


@pytest.mark.parametrize("law", LAWS, ids=["exp", "eq5", "tank"])
@given(temp=temps, seen_as=temps, phase=phases, supply=st.floats(0.8, 1.1))
def test_a_rezeroed_law_reads_the_given_temperature(
    law: laws.Law, temp: float, seen_as: float, phase: int, supply: float
) -> None:
    error = law.error(seen_as, phase, supply)
    assert law.rezeroed(temp, error, phase, supply).invert(error, phase, supply)[0] == pytest.approx(
        temp, abs=1e-6
    )


@given(temp=temps, phase=phases, supply=st.floats(0.7, 1.2))
def test_tank_law_inverts_at_any_supply(temp: float, phase: int, supply: float) -> None:
    law = laws.TankLaw()
    got = law.invert(law.error(temp, phase, supply), phase, supply)
    assert got[0] == pytest.approx(temp, abs=1e-6)


def test_tank_law_gives_table_1_back_better_than_the_exp_law() -> None:
    errors = residuals(laws.TankLaw(), 20.0, 25.0, 500.0)
    # Figures of the fit: max 1.91, rms 1.09 degC; coefficients here are rounded.
    assert max(abs(e) for e in errors) < 2.0
    assert math.sqrt(sum(e * e for e in errors) / len(errors)) < 1.15


def test_a_law_survives_the_way_through_its_coefficients() -> None:
    law = laws.TankLaw(delta=12.0)
    name, values = laws.coefficients_of(law)
    assert laws.law_of(name, values, law.residual_units) == law
