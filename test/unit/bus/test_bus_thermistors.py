"""Thermistors by table, with a parallel resistor, and by polynomial; platinum sensors with their circuits."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import pytest

from bus_rig import BusSession, run, start_error
from extras import adc_temperature, thermistor
from extras.polynomial_thermistor import Polynomial

DATA = Path(__file__).resolve().parents[2] / "data"
LIU = (-19.3535, 114.7015, -79.9385)  # the published coefficients of eq 2


def rows_of(name: str) -> list[dict[str, float]]:
    with (DATA / name).open(newline="") as file:
        lines = (line for line in file if not line.startswith("#"))
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(lines)]


def test_a_table_goes_through_its_rows_and_back() -> None:
    rows = tuple((row["temp_c"], row["ohm"]) for row in rows_of("hydraraptor2007_thermistor.csv"))
    law = thermistor.Table(rows)
    for temp_c, ohm in rows:
        assert law.temp_c(ohm) == pytest.approx(temp_c, abs=1e-9)
        assert law.ohm(temp_c) == pytest.approx(ohm)


def test_between_rows_a_table_follows_a_beta_law_exactly() -> None:
    law = thermistor.fit_beta(25.0, 100e3, 3950.0)
    table = thermistor.Table(tuple((t, law.ohm(t)) for t in (0.0, 50.0, 150.0, 300.0)))
    for temp_c in (-20.0, 25.0, 100.0, 200.0, 320.0):
        assert table.temp_c(law.ohm(temp_c)) == pytest.approx(temp_c, abs=1e-6)


@pytest.mark.parametrize("rows", [((0.0, 10.0), (50.0, 5.0), (100.0, 5.0)), ((0.0, 10.0), (0.0, 9.0))])
def test_tables_that_no_thermistor_has_are_refused(rows: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ValueError):
        thermistor.Table(rows)


def test_the_parallel_resistor_is_part_of_the_circuit() -> None:
    law = thermistor.fit_beta(25.0, 10e3, 3480.0)
    curve = thermistor.Thermistor(1000.0, 0.0, law, 560.0)
    load = 1.0 / (1.0 / law.ohm(200.0) + 1.0 / 560.0)
    assert curve.calc_adc(200.0) == pytest.approx(load / (load + 1000.0))
    for temp_c in (60.0, 150.0, 260.0):
        assert curve.calc_temp(curve.calc_adc(temp_c)) == pytest.approx(temp_c, abs=1e-6)


def test_an_open_or_shorted_sensor_beside_its_parallel_resistor_reads_as_far_out() -> None:
    curve = thermistor.Thermistor(1000.0, 0.0, thermistor.fit_beta(25.0, 10e3, 3480.0), 560.0)
    assert curve.calc_temp(560.0 / 1560.0) < -40.0
    assert curve.calc_temp(0.9) < -40.0, "more than the parallel resistor alone: still open"
    assert curve.calc_temp(0.0) > 600.0
    assert curve.calc_adc(-300.0) == pytest.approx(560.0 / 1560.0)


TABLE = """
[thermistor rrrf]
temperature1: 20
resistance1: 12000
temperature2: 100
resistance2: 900
temperature3: 180
resistance3: 150
temperature4: 260
resistance4: 40
[temperature_sensor s]
sensor_type: rrrf
sensor_pin: PA1
pullup_resistor: 1000
parallel_resistor: 560
min_temp: 0
max_temp: 270
"""


def test_a_section_with_four_points_is_a_table(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        load = 1.0 / (1.0 / 150.0 + 1.0 / 560.0)
        s.chip.pins["PA1"].callback(1.0, load / (load + 1000.0))
        assert s.status("temperature_sensor s")["temperature"] == pytest.approx(180.0, abs=0.01)
        limits = s.chip.pins["PA1"].setup["sample"]
        assert 0.0 < limits["minval"] < limits["maxval"] < 560.0 / 1560.0

    run(tmp_path, TABLE, body)


@pytest.mark.parametrize("name", ["Generic 3950", "SliceEngineering 450", "rrrf"])
@pytest.mark.parametrize(("low_c", "high_c"), [(-273.0, 300.0), (-272.0, 1e8)])
def test_limits_that_no_thermistor_can_read_are_the_ends_of_the_adc(
    tmp_path: Path, name: str, low_c: float, high_c: float
) -> None:
    def body(s: BusSession) -> None:
        limits = s.chip.pins["PA1"].setup["sample"]
        assert (
            0.0 <= limits["minval"] < 0.25 and limits["maxval"] > 0.35
        )  # 560 of 1560 ohm with no thermistor

    text = TABLE.replace("sensor_type: rrrf", f"sensor_type: {name}")
    run(tmp_path, text.replace("min_temp: 0", f"min_temp: {low_c}").replace("270", str(high_c)), body)


@pytest.mark.parametrize("beta", ["39.5", "395000"])
def test_a_beta_that_no_part_has_is_refused(tmp_path: Path, beta: str) -> None:
    """With the larger one every reading is 25 degC, and a heater would be hot before anybody knew."""
    section = f"[thermistor t]\ntemperature1: 25\nresistance1: 100000\nbeta: {beta}\n"
    reason = start_error(tmp_path, section + "[temperature_sensor s]\nsensor_type: t\nsensor_pin: PA1\n")
    assert "'beta' in section 'thermistor t'" in reason


# ---------------------------------------------------------------- the polynomial of Liu 2019


def test_the_published_polynomial_has_the_published_table_s_fitness() -> None:
    """Eq 3 on Table 1: 1.367 degC (the paper's 0.69 cannot be had from these numbers)."""
    curve = Polynomial(LIU, 5.0, 3.4, 4.9)
    rows = rows_of("liu2019_table1.csv")
    squares = [(curve.calc_temp(row["volt"] / 5.0) - row["temp_c"]) ** 2 for row in rows]
    assert math.sqrt(sum(squares) / (len(rows) - 1)) == pytest.approx(1.367, abs=0.001)


def test_outside_its_range_a_polynomial_goes_straight_on() -> None:
    curve = Polynomial(LIU, 5.0, 3.4, 4.9)
    hot, hotter = curve.calc_temp(3.3 / 5.0), curve.calc_temp(2.0 / 5.0)
    assert curve.range_c[1] < hot < hotter, "hotter never reads colder"
    assert curve.calc_temp(1.0) < curve.range_c[0]


@pytest.mark.parametrize("temp_c", [0.0, 25.0, 60.0, 85.0, 95.0])
def test_a_polynomial_inverts(temp_c: float) -> None:
    curve = Polynomial(LIU, 5.0, 3.4, 4.9)
    assert curve.calc_temp(curve.calc_adc(temp_c)) == pytest.approx(temp_c, abs=1e-6)


POLYNOMIAL = """
[polynomial_thermistor liu]
coefficients: -19.3535, 114.7015, -79.9385
min_voltage: {low}
max_voltage: 4.9
[temperature_sensor s]
sensor_type: liu
sensor_pin: PA1
min_temp: 0
max_temp: {max}
"""


def test_a_polynomial_becomes_a_sensor_type(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        s.chip.pins["PA1"].callback(1.0, 4.4401 / 5.0)
        assert s.status("temperature_sensor s")["temperature"] == pytest.approx(47.81, abs=0.02)
        assert s.chip.pins["PA1"].setup["sample"]["minval"] > 3.4 / 5.0

    run(tmp_path, POLYNOMIAL.replace("{low}", "3.4").replace("{max}", "80"), body)


def test_a_polynomial_that_turns_round_is_refused(tmp_path: Path) -> None:
    reason = start_error(tmp_path, POLYNOMIAL.replace("{low}", "0").replace("{max}", "80"))
    assert "polynomial_thermistor liu" in reason and "90.0 degrees" in reason


def test_a_heater_beyond_the_polynomial_is_refused(tmp_path: Path) -> None:
    reason = start_error(tmp_path, POLYNOMIAL.replace("{low}", "3.4").replace("{max}", "250"))
    assert "max_temp" in reason and "250" in reason
    reason = start_error(tmp_path, POLYNOMIAL.replace("{low}", "3.4").replace("max_temp: {max}", ""))
    assert "needs a max_temp of 86" in reason and "it has none" in reason


# ---------------------------------------------------------------- platinum


def test_the_pt100_amplifier_gives_its_maker_s_voltages() -> None:
    # E3D's board: 1.11 V at 0, 1.52 V at 100, 2.66 V at 400 degC, two decimals
    points = dict(adc_temperature._ina826_points())
    for temp_c, volt in ((0.0, 1.11), (100.0, 1.52), (400.0, 2.66)):
        assert points[temp_c] == pytest.approx(volt, abs=0.007)


@pytest.mark.parametrize("kind", ["PT1000", "PT100 INA826"])
@pytest.mark.parametrize("temp_c", [0.0, 25.0, 111.0, 250.0, 412.0])
def test_platinum_sensors_read_true(tmp_path: Path, kind: str, temp_c: float) -> None:
    """Against IEC 60751 and the circuit; the tables' steps of 25 degC cost up to 0.05 degC."""
    ohm = adc_temperature.platinum_ohm(1000.0 if kind == "PT1000" else 100.0, temp_c)
    ratio = ohm / (ohm + 4700.0) if kind == "PT1000" else 10.0 * ohm / (ohm + 4400.0)

    def body(s: BusSession) -> None:
        s.chip.pins["PA1"].callback(1.0, ratio)
        assert s.status("temperature_sensor s")["temperature"] == pytest.approx(temp_c, abs=0.06)

    config = f"[temperature_sensor s]\nsensor_type: {kind}\nsensor_pin: PA1\nmin_temp: 0\nmax_temp: 450\n"
    run(tmp_path, config, body)
