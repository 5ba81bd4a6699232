"""Thermistor fits against the published tables of two sources and against circuits made here."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import fit_thermistor as script
from configtext import ConfigData, ConfigParser
from extras.polynomial_thermistor import Polynomial
from thermal.identification.fit_data import read_columns
from thermal.identification.fit_thermistor import Divider, ThermistorFitError, evaluate, fit_thermistor

DATA = Path(__file__).parents[2] / "data"
LIU = read_columns(DATA / "liu2019_table1.csv")
HYDRARAPTOR = read_columns(DATA / "hydraraptor2007_thermistor.csv")
GRID_C = 25.0 + 3.0 * np.arange(21)  # what the printed temperatures of Liu's table are misprints of
LIU_PSO = {"a2": -19.3535, "a1": 114.7015, "a0": -79.9385}  # the paper's coefficients


@pytest.mark.parametrize(("temp_c", "expected"), [(LIU["temp_c"], 1.3669), (GRID_C, 1.0404)])
def test_the_papers_coefficients_have_the_fitness_found_and_not_the_claimed_one(
    temp_c: np.ndarray, expected: float
) -> None:
    got = evaluate("polynomial", LIU_PSO, LIU["volt"], temp_c).fitness_c
    assert got == pytest.approx(expected, abs=2e-4)  # coefficients are printed to four decimals
    assert got > 0.6948  # what the paper states


@pytest.mark.parametrize("method", ["lsq", "pso"])
@pytest.mark.parametrize(("temp_c", "expected"), [(LIU["temp_c"], 1.202), (GRID_C, 0.9109)])
def test_no_quadratic_does_better_than_the_least_squares_one(
    method: str, temp_c: np.ndarray, expected: float
) -> None:
    assert fit_thermistor("polynomial", method, LIU["volt"], temp_c).fitness_c == pytest.approx(
        expected, abs=1e-3
    )


def test_lius_sensor_is_a_common_100k_bead_on_the_true_grid() -> None:
    ohm = Divider(pullup_ohm=4700.0, supply_v=5.0).ohms(LIU["volt"])
    fit = fit_thermistor("beta", "lsq", ohm, GRID_C)
    assert fit.coefficients["r25"] == pytest.approx(100e3, rel=1e-3)
    assert fit.coefficients["beta"] == pytest.approx(3950, rel=1e-3)
    assert fit.fitness_c < 0.01  # voltages are printed to 0.1 mV


def test_hydraraptors_bead_gives_its_beta_and_steinhart_hart_figures() -> None:
    beta = fit_thermistor("beta", "lsq", HYDRARAPTOR["ohm"], HYDRARAPTOR["temp_c"])
    assert beta.coefficients["beta"] == pytest.approx(3565, abs=1)
    assert beta.coefficients["r25"] == pytest.approx(2113, abs=1)
    steinhart = fit_thermistor("steinhart", "lsq", HYDRARAPTOR["ohm"], HYDRARAPTOR["temp_c"])
    expected = {"a": 0.0013106129, "b": 0.000245512838, "c": 4.2703963e-07}
    assert steinhart.coefficients == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("model", ["beta", "steinhart"])
def test_the_swarm_is_never_worse_than_least_squares_in_its_own_measure(model: str) -> None:
    x, temp_c = HYDRARAPTOR["ohm"], HYDRARAPTOR["temp_c"]
    swarm, lsq = (fit_thermistor(model, method, x, temp_c) for method in ("pso", "lsq"))
    assert swarm.fitness_c <= lsq.fitness_c
    assert fit_thermistor(model, "pso", x, temp_c).coefficients == swarm.coefficients  # seeded: repeatable


@pytest.mark.parametrize("parallel_ohm", [float("inf"), 100.0])
def test_a_divider_turns_volts_into_the_resistance_they_came_from(parallel_ohm: float) -> None:
    divider = Divider(1000.0, 5.0, parallel_ohm)
    ohm = np.array([12.0, 145.0, 2108.0])
    assert divider.ohms(divider.volts(ohm)) == pytest.approx(ohm, rel=1e-9)


def test_a_voltage_the_circuit_cannot_give_is_refused() -> None:
    with pytest.raises(ThermistorFitError, match="supply"):
        Divider(4700.0, 5.0).ohms(np.array([5.1]))
    with pytest.raises(ThermistorFitError, match="parallel"):
        Divider(1000.0, 5.0, 100.0).ohms(np.array([2.5]))


def test_the_script_writes_section_json_and_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, plot = tmp_path / "fit.json", tmp_path / "fit.png"
    table = str(DATA / "hydraraptor2007_thermistor.csv")
    assert script.main([table, "--json", str(out), "--plot", str(plot)]) == 0
    text = capsys.readouterr().out
    assert "[thermistor my_sensor]" in text and "resistance3" in text
    assert {row["model"] for row in json.loads(out.read_text())} == {"beta", "steinhart"}
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_the_printed_polynomial_section_reads_what_was_fitted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The section is taken apart as printer.cfg would be."""
    table = tmp_path / "liu.csv"
    rows = zip(GRID_C, LIU["volt"], strict=True)
    table.write_text("temp_c,volt\n" + "".join(f"{t},{v}\n" for t, v in rows))
    assert script.main([str(table), "--supply", "5"]) == 0
    data = ConfigData()
    ConfigParser(data).parse_text(capsys.readouterr().out.partition("\n\n")[2], "printed")
    section = {k: o.value for k, o in data.sections["polynomial_thermistor my_sensor"].options.items()}
    low_v, high_v, adc_v = (float(section[k]) for k in ("min_voltage", "max_voltage", "adc_voltage"))
    curve = Polynomial([float(c) for c in section["coefficients"].split(",")], adc_v, low_v, high_v)
    best = fit_thermistor("polynomial", "lsq", LIU["volt"], GRID_C)
    read_c = np.array([curve.calc_temp(v / 5.0) for v in LIU["volt"]])
    assert read_c - GRID_C == pytest.approx(best.residual_c, abs=2e-3)


def test_a_polynomial_that_turns_round_is_not_offered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "bent.csv"
    table.write_text(
        "temp_c,volt\n" + "".join(f"{100 - (v - 2) ** 2 * 20},{v}\n" for v in (0.5, 1, 1.5, 2.5, 3, 3.5))
    )
    assert script.main([str(table), "--supply", "5"]) == 0
    text = capsys.readouterr().out
    assert "# no [polynomial_thermistor]: the polynomial turns round" in text


def bead(more: str = "") -> str:
    rows = [(t, 1e5 * np.exp(3950 * (1 / (t + 273.15) - 1 / 298.15))) for t in range(20, 280, 20)]
    return "temp_c,ohm\n" + "".join(f"{t},{ohm:.1f}\n" for t, ohm in rows) + more


def test_a_table_saved_by_a_spreadsheet_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A mark at its beginning, lines that end in CR LF."""
    path, plain = tmp_path / "excel.csv", tmp_path / "plain.csv"
    plain.write_text(bead())
    path.write_bytes(("\ufeff" + bead().replace("\n", "\r\n")).encode())
    texts = []
    for table in (plain, path):
        assert script.main([str(table), "--method", "lsq"]) == 0
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[1] and "beta=3950." in texts[0]


def test_platinum_is_not_offered_as_a_thermistor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "pt1000.csv"
    path.write_text(
        "temp_c,ohm\n" + "".join(f"{t},{1000 * (1 + 0.00385 * t):.1f}\n" for t in range(20, 280, 20))
    )
    assert script.main([str(path), "--method", "lsq"]) == 0
    text = capsys.readouterr().out
    assert "# no [thermistor]: its resistance rises" in text and "\n[thermistor" not in text


@pytest.mark.parametrize(
    ("text", "args", "expected"),
    [
        ("a,b\n1,2\n", [], "columns must be"),
        ("temp_c,ohm\n20,1000\n30,900\n", [], "too few"),
        ("temp_c,ohm\n20,1000\n30,-5\n40,5\n50,4\n", [], "positive"),
        ("temp_c,ohm\n20,1000\n21,900\n22,800\n22.5,700\n", [], "spans only"),
        ("temp_c;ohm\n20;1000,5\n30;900\n", [], "separated by commas"),
        ("temp_c\tohm\n20\t1000\n", [], "separated by commas"),
        ("temp_c,ohm\n20,1000\n", ["--pullup", "-3"], "must be positive"),
    ],
)
def test_unusable_input_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, args: list[str], expected: str
) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    assert script.main([str(path), *args]) == 2
    message = capsys.readouterr().err
    assert expected in message and message.count("\n") == 1
