"""Thermistors and ADC tables: there and back, against published points, with errors for impossible ones."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from configtext import ConfigError
from extras import adc_temperature, heaters, thermistor
from heater_fakes import FakePrinter

LAWS = {
    "beta": thermistor.fit_beta(25.0, 100e3, 3950.0),
    "points": thermistor.fit_points(((25.0, 500000.0), (200.0, 3734.0), (400.0, 240.0))),
}


@pytest.mark.parametrize("name", LAWS)
@given(temp=st.floats(-30.0, 350.0))
def test_resistance_and_ratio_invert(name: str, temp: float) -> None:
    law = LAWS[name]
    curve = thermistor.Thermistor(4700.0, 100.0, law)
    assert law.temp_c(law.ohm(temp)) == pytest.approx(temp, abs=1e-6)
    assert curve.calc_temp(curve.calc_adc(temp)) == pytest.approx(temp, abs=0.05)


def test_curve_goes_through_its_three_points() -> None:
    law = LAWS["points"]
    for temp, ohm in ((25.0, 500000.0), (200.0, 3734.0), (400.0, 240.0)):
        assert law.temp_c(ohm) == pytest.approx(temp, abs=1e-6)


def test_beta_law_gives_the_thermistor_of_liu_2019() -> None:
    """R25 = 100 kohm, beta 3950, 4.7 kohm pull-up, 5 V: 25 degC is 4.776 V (100/104.7 of 5 V)."""
    curve = thermistor.Thermistor(4700.0, 0.0, LAWS["beta"])
    assert 5.0 * curve.calc_adc(25.0) == pytest.approx(5.0 * 100.0 / 104.7)


def test_a_plugin_gives_the_resistors_and_sets_the_curve_afterwards() -> None:
    curve = thermistor.Thermistor(4700.0, 100.0)
    curve.setup_coefficients_beta(25.0, 100e3, 3950.0)
    assert curve.calc_adc(25.0) == pytest.approx((100e3 + 100.0) / (100e3 + 100.0 + 4700.0))
    assert curve.calc_temp(curve.calc_adc(210.0)) == pytest.approx(210.0)
    curve.setup_coefficients(25.0, 500000.0, 200.0, 3734.0, 400.0, 240.0, name="hotend")
    assert curve.calc_adc(200.0) == pytest.approx((3734.0 + 100.0) / (3734.0 + 100.0 + 4700.0))
    with pytest.raises(ValueError, match="hotend: resistance must fall with temperature"):
        curve.setup_coefficients(25.0, 1000.0, 100.0, 2000.0, 200.0, 3000.0, name="hotend")


def test_a_thermistor_without_a_curve_says_what_is_missing() -> None:
    with pytest.raises(ValueError, match="setup_coefficients"):
        thermistor.Thermistor(4700.0, 0.0).calc_temp(0.5)


def test_a_plugin_derives_from_the_thermistor() -> None:
    class Scaled(thermistor.Thermistor):
        """Its board divides the signal once more."""

        def __init__(self, pullup: float, inline_resistor: float) -> None:
            thermistor.Thermistor.__init__(self, pullup, inline_resistor)

        def calc_temp(self, adc: float) -> float:
            return super().calc_temp(2.0 * adc)

    curve = Scaled(4700.0, 0.0)
    curve.setup_coefficients_beta(25.0, 100e3, 3950.0)
    assert (curve.pullup, curve.inline_resistor) == (4700.0, 0.0)
    assert curve.calc_temp(0.5 * curve.calc_adc(60.0)) == pytest.approx(60.0)


def test_open_and_shorted_sensors_give_finite_extremes() -> None:
    curve = thermistor.Thermistor(4700.0, 0.0, LAWS["beta"])
    assert curve.calc_temp(1.0) < -50.0
    assert curve.calc_temp(0.0) > 600.0


def test_points_that_no_thermistor_has_are_refused() -> None:
    with pytest.raises(ValueError, match="fall with temperature"):
        thermistor.fit_points(((25.0, 1000.0), (100.0, 2000.0), (200.0, 3000.0)))


def test_platinum_matches_iec_60751() -> None:
    # Table values of the standard, two decimals of an ohm for PT100.
    for temp, ohm in ((-50.0, 80.31), (0.0, 100.0), (100.0, 138.51), (400.0, 247.09)):
        assert adc_temperature.platinum_ohm(100.0, temp) == pytest.approx(ohm, abs=0.006)


def test_tables_interpolate_prolong_and_invert() -> None:
    curve = adc_temperature.LinearVoltage([(0.0, 0.0), (100.0, 1.0), (200.0, 3.0)], 5.0, 0.0)
    assert curve.calc_temp(0.1) == pytest.approx(50.0)
    assert curve.calc_temp(0.4) == pytest.approx(150.0)
    assert curve.calc_temp(0.8) == pytest.approx(250.0)
    assert curve.calc_adc(150.0) == pytest.approx(0.4)


@pytest.mark.parametrize(
    "points", [[(0.0, 1.0)], [(0.0, 1.0), (50.0, 2.0), (100.0, 1.5)], [(0.0, 1.0), (9.0, 1.0)]]
)
def test_tables_that_are_not_one_to_one_are_refused(points: list[tuple[float, float]]) -> None:
    with pytest.raises(ValueError):
        adc_temperature.LinearResistance(points, 4700.0)


CUSTOM = """
[thermistor mine]
temperature1: 25
resistance1: 10000
beta: 3434
[thermistor twisted]
temperature1: 25
resistance1: 100
temperature2: 100
resistance2: 200
temperature3: 200
resistance3: 300
[adc_temperature ramp]
temperature1: 0
voltage1: 0.5
temperature2: 100
voltage2: 1.5
[probe]
sensor_type: {kind}
sensor_pin: PA1
adc_voltage: 5
"""


def machine(kind: str, without: str) -> FakePrinter:
    text = CUSTOM.replace("{kind}", kind)
    head, _, tail = text.partition(f"[thermistor {without}]")
    text = head + tail[tail.index("[", 1) :] if tail else text
    loaders = {
        "heaters": heaters.load_config,
        "thermistor": thermistor.load_config_prefix,
        "adc_temperature": adc_temperature.load_config_prefix,
    }
    return FakePrinter(text, loaders)


@pytest.mark.parametrize(("kind", "ratio", "temp"), [("mine", 10000.0 / 14700.0, 25.0), ("ramp", 0.2, 50.0)])
def test_custom_sections_become_sensor_types_wherever_they_stand(
    kind: str, ratio: float, temp: float
) -> None:
    printer = machine(kind, without="twisted")
    sensor = printer.load("heaters").setup_sensor(printer.config("probe"))
    seen: list[float] = []
    sensor.setup_callback(lambda time, temp_c: seen.append(temp_c))
    callback = printer.pins["PA1"].callback
    assert callback is not None
    callback(1.0, ratio)
    assert seen == [pytest.approx(temp, abs=1e-6)]


def test_an_impossible_custom_thermistor_is_a_config_error_with_its_name() -> None:
    printer = machine("mine", without="nothing")
    with pytest.raises(ConfigError, match="thermistor twisted"):
        printer.load("heaters").setup_sensor(printer.config("probe"))


@pytest.mark.parametrize(
    "name",
    [
        "EPCOS 100K B57560G104F",
        "ATC Semitec 104GT-2",
        "Generic 3950",
        "PT1000",
        "AD595",
        "SliceEngineering 450",
    ],
)
def test_common_types_are_built_in(name: str) -> None:
    printer = machine(name, without="twisted")
    sensor = printer.load("heaters").setup_sensor(printer.config("probe"))
    curve = sensor.curve
    assert curve.calc_temp(curve.calc_adc(200.0)) == pytest.approx(200.0, abs=0.1)
