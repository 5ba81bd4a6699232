"""The offline thermometer fit, against the published tables and against recordings made here."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fit_sensor
from thermal.identification import fit_data, fit_sensing
from thermal.sensing import laws

TABLE1 = Path(__file__).parents[2] / "data" / "oskolkov2021_table1.csv"
# Table 2 of Sensors 2021, 21(7), 2561: estimate, standard error
TABLE2 = {
    "C": (0.797, 1.18),
    "A": (0.825, 0.002717),
    "B": (0.0001081, 0.0001006),
    "AB": (-7.085e-06, 2.315e-07),
    "BB": (4.951e-10, 1.982e-09),
    "ABB": (-1.207e-10, 4.562e-12),
}
EXP_LAW = {"a": 0.801361, "b": 1.058014, "c": 1.397019, "d": 5.139702}
TANK_LAW = {"g": 1154.0, "t0": 390.0, "w": 1430.0, "delta": -60.0, "b": 0.5, "q": 0.55}
TANK_LAW |= {"c": 20.0, "d": 300.0, "m": 1.05}


@pytest.fixture(scope="module")
def table1() -> fit_sensing.Points:
    points = fit_data.read_calibration(TABLE1)
    assert isinstance(points, fit_sensing.Points)
    return points


def factorial(noise_units: float, seed: int = 0) -> fit_sensing.Points:
    """The paper's 11 powers x 73 temperatures, rebuilt from the four-parameter law plus its own scatter."""
    power, temp = np.meshgrid([0.002, *np.arange(0.1, 1.01, 0.1)], np.arange(30.0, 751.0, 10.0))
    temp, ticks = temp.ravel(), fit_sensing.ticks_of_power(power.ravel())
    noise = np.random.default_rng(seed).normal(0.0, noise_units, temp.size)
    return fit_sensing.Points(temp, ticks, fit_sensing.predict("exp", EXP_LAW, temp, ticks) + noise)


def test_exp_law_on_table_1_gives_its_published_derivation(table1: fit_sensing.Points) -> None:
    result = fit_sensing.fit_exp(table1)
    for name, value in EXP_LAW.items():
        assert result.values()[name] == pytest.approx(value, rel=1e-4)  # printed to six digits
    assert result.residual_sd == pytest.approx(0.98, abs=0.01)
    at_work = table1.where((table1.power < 0.201) & (table1.temp_c <= 500))
    residual = fit_sensing.temperature_residuals("exp", result.values(), at_work)
    assert np.abs(residual).max() == pytest.approx(2.5, abs=0.05)
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(1.3, abs=0.05)


def test_eq5_on_table_1_reaches_the_regression_figures(table1: fit_sensing.Points) -> None:
    result = fit_sensing.fit_eq5(table1)
    assert result.r == pytest.approx(0.9999, abs=0.00005)
    assert result.f == pytest.approx(2.4e4, rel=0.03)
    assert result.significant


def test_eq5_agrees_with_an_independent_solution_of_the_normal_equations(table1: fit_sensing.Points) -> None:
    # columns in units of the full phase keep the plain normal equations well conditioned
    t, n = table1.temp_c, table1.phase_ticks / fit_sensing.PHASE_FULL_TICKS
    design = np.stack([t**0, t, n, t * n, n**2, t * n**2], axis=1)
    beta = np.linalg.solve(design.T @ design, design.T @ table1.error)
    units = fit_sensing.PHASE_FULL_TICKS ** np.array([0, 0, 1, 1, 2, 2])
    got = fit_sensing.fit_eq5(table1).values()
    for name, value in zip(fit_sensing.EQ5_NAMES, beta / units, strict=True):
        assert got[name] == pytest.approx(value, rel=0.01)


def test_the_papers_factorial_gives_table_2_back() -> None:
    result = fit_sensing.fit_eq5(
        factorial(noise_units=0.0)
    )  # the law's mean: no draw of noise can help or hurt
    for coefficient in result.coefficients:
        estimate, std_error = TABLE2[coefficient.name]
        assert abs(coefficient.estimate - estimate) < 2 * std_error, coefficient.name
        assert coefficient.std_error == pytest.approx(std_error, rel=0.1)


def test_the_papers_factorial_gives_its_f_figure() -> None:
    # Table 1 scatters by 0.975 units about the law; F is judged over draws of that scatter, not one of them
    draws = [fit_sensing.fit_eq5(factorial(noise_units=0.975, seed=seed)).f for seed in range(20)]
    assert 1.1e5 < np.median(draws) < 1.3e5


def test_equation_5_cannot_reach_three_degrees_at_full_power_but_does_not_hide_it(
    table1: fit_sensing.Points,
) -> None:
    residual = fit_sensing.temperature_residuals("eq5", {k: v[0] for k, v in TABLE2.items()}, table1)
    inside = (table1.temp_c >= 50) & (table1.temp_c <= 350)
    assert np.abs(residual[inside]).max() == pytest.approx(15.5, abs=1.0)
    assert np.sqrt(np.mean(residual[inside] ** 2)) == pytest.approx(7.0, abs=0.5)


@given(st.floats(20, 600), st.floats(0.002, 1.0))
@settings(max_examples=200, deadline=None)
def test_every_law_inverts_what_it_predicts(temp_c: float, power: float) -> None:
    temp, ticks = np.array([temp_c]), fit_sensing.ticks_of_power(np.array([power]))
    for law, values in (
        ("eq5", {k: v[0] for k, v in TABLE2.items()}),
        ("exp", EXP_LAW),
        ("tank", TANK_LAW),
    ):
        error = fit_sensing.predict(law, values, temp, ticks)
        assert fit_sensing.invert(law, values, error, ticks)[0] == pytest.approx(temp_c, abs=1e-6)


def test_tank_law_recovers_a_tank_that_the_exp_law_cannot_follow() -> None:
    temp, power = np.meshgrid(np.arange(30.0, 501.0, 10.0), [0.002, 0.1, 0.2, 0.5, 1.0])
    temp, ticks = temp.ravel(), fit_sensing.ticks_of_power(power.ravel())
    noise = np.random.default_rng(1).normal(0.0, 0.1, temp.size)
    points = fit_sensing.Points(temp, ticks, fit_sensing.predict("tank", TANK_LAW, temp, ticks) + noise)
    tank, four = fit_sensing.fit_tank(points), fit_sensing.fit_exp(points)
    assert tank.residual_sd == pytest.approx(0.1, rel=0.2)  # nothing but the noise is left
    assert four.residual_sd > 10 * tank.residual_sd


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=200), st.floats(0.01, 20))
@settings(max_examples=100, deadline=None)
def test_reduced_curve_stays_within_its_tolerance(values: list[float], tolerance: float) -> None:
    y = np.array(values)
    x = np.arange(y.size, dtype=float)
    kept = fit_sensing.reduce_curve(x, y, tolerance)
    assert kept[0] == 0 and kept[-1] == y.size - 1
    assert np.abs(np.interp(x, x[kept], y[kept]) - y).max() <= tolerance * (1 + 1e-12)


def heating_run(power: float, start_s: float) -> str:
    t = np.arange(0, 5, 0.01)
    temp = 25 + 190 * t - 12 * t**2
    ticks = fit_sensing.ticks_of_power(np.full(t.size, power))
    noise = np.random.default_rng(int(power * 1000)).normal(0, 0.3, t.size)
    error = fit_sensing.predict("exp", EXP_LAW, temp, ticks) + noise
    rows = zip(t + start_s, temp, error, ticks, strict=True)
    return "".join(",".join(f"{v:.6f}" for v in row) + "\n" for row in rows)


@pytest.mark.parametrize("recipe", ["direct", "paper"])
def test_a_recorded_sweep_is_fitted_by_either_recipe(tmp_path: Path, recipe: str) -> None:
    trace, out = tmp_path / "trace.csv", tmp_path / "fit.json"
    runs = [heating_run(power, 20 * i) for i, power in enumerate([0.002, 0.1, 0.2, 0.5, 1.0])]
    trace.write_text("t_s,temp_ref_c,error,phase_ticks\n" + "".join(runs))
    plot = tmp_path / "fit.png"
    args = [str(trace), "--recipe", recipe, "--json", str(out), "--plot", str(plot)]
    assert fit_sensor.main(args) == 0
    got = json.loads(out.read_text())["coefficients"]
    # 0.3 units of noise on 500 points a run, and a quadratic fitted to a run that is one: 1 % is ample
    assert got["a"] == pytest.approx(EXP_LAW["a"], rel=0.01)
    assert got["b"] == pytest.approx(EXP_LAW["b"], rel=0.02)
    assert plot.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "empty"),
        ("power_pct,temp_c,error\n", "no data"),
        ("power_pct,temp_c,error\n1,2\n", "row 2"),
        ("power_pct,temp_c,error\n1,2,abc\n", "abc"),
        ("power_pct,temp_c,error\n1,nan,5\n" * 1 + "2,30,5\n" * 8, "finite"),
        ("power_pct,temp_c,error\n" + "5,100,80\n" * 9, "different powers"),
        ("power_pct,temp_c,error\n" + "200,100,80\n" * 9, "between 0 and 100"),
        ("a,b\n1,2\n", "expected either"),
    ],
)
def test_unusable_input_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, expected: str
) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    assert fit_sensor.main([str(path)]) == 2
    message = capsys.readouterr().err
    assert expected in message
    assert message.count("\n") == 1


@pytest.mark.parametrize(
    ("option", "name", "expected"),
    [("--json", "nowhere/out.json", "No such file"), ("--plot", "out.nonsense", "nonsense")],
)
def test_output_that_cannot_be_written_is_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, name: str, expected: str
) -> None:
    assert fit_sensor.main([str(TABLE1), option, str(tmp_path / name)]) == 2
    message = capsys.readouterr().err
    assert expected in message
    assert message.count("\n") == 1


def test_a_binary_file_is_named_as_what_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "picture.csv"
    path.write_bytes(b"\x89PNG\xff\xfe")
    assert fit_sensor.main([str(path)]) == 2
    assert capsys.readouterr().err == f"fit_sensor: {path} is no text file\n"


def test_offline_and_printing_code_agree_on_every_law() -> None:
    temp, power = np.meshgrid(np.arange(30.0, 501.0, 47.0), [0.002, 0.07, 0.4, 1.0])
    temp, ticks = temp.ravel(), fit_sensing.ticks_of_power(power.ravel())
    for name, values in (("eq5", {k: v[0] for k, v in TABLE2.items()}), ("exp", EXP_LAW), ("tank", TANK_LAW)):
        law = laws.law_of(name, values)
        error = fit_sensing.predict(name, values, temp, ticks)
        assert error == pytest.approx([law.error(t, n) for t, n in zip(temp, ticks, strict=True)], abs=1e-6)
        back = [law.invert(e, n)[0] for e, n in zip(error, ticks, strict=True)]
        assert fit_sensing.invert(name, values, error, ticks) == pytest.approx(back, abs=1e-6)


def test_shipped_tank_law_is_the_fit_of_table_1(table1: fit_sensing.Points) -> None:
    result = fit_sensing.fit_tank(table1)
    shipped = laws.coefficients_of(laws.TankLaw())[1]
    for name, value in result.values().items():
        assert shipped[name] == pytest.approx(value, rel=1e-3, abs=0.01)  # rounded
    assert result.residual_sd == pytest.approx(1.0, abs=0.1)
