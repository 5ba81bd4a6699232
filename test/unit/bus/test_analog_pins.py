"""Analog pins that are not plain ones of the board: scaled by its reference, or of a converter on I2C."""

from __future__ import annotations

from pathlib import Path

import pytest

from base_rig import Session
from bus_devices import Ads1115, attach, on_i2c
from bus_rig import BusSession, run, start_error

SCALED = "[adc_scaled v]\nvref_pin: PC0\nvssa_pin: PC1\n"
TABLE = "[adc_temperature share]\ntemperature1: 0\nvoltage1: 0\ntemperature2: 100\nvoltage2: 1\n"
SENSOR = f"{TABLE}[temperature_sensor s]\nsensor_type: share\nadc_voltage: 1\nmin_temp: 0\nmax_temp: 90\n"


def report(s: BusSession, time_s: float, **values: float) -> None:
    """Readings of the board's pins."""
    for pin, value in values.items():
        s.chip.pins[pin].last = (value, time_s)
        s.chip.pins[pin].callback(time_s, value)


def measured(s: BusSession) -> float:
    return float(s.status("temperature_sensor s")["temperature"])


def test_a_scaled_pin_reads_between_ground_and_reference(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        for i in range(40):
            report(s, 0.3 * i, PC0=0.9, PC1=0.1, PC2=0.5)
        assert measured(s) == pytest.approx(50.0)
        s.gcode.run_script('QUERY_ADC NAME="temperature_sensor s"')
        assert "value 0.500000" in s.lines[-1]
        for i in range(40, 80):
            report(s, 0.3 * i, PC2=0.7)
        assert measured(s) == pytest.approx(75.0)

    run(tmp_path, SCALED + SENSOR + "sensor_pin: v:PC2\n", body)


def test_the_reference_is_smoothed(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        report(s, 0.0, PC0=0.9, PC1=0.1)
        report(s, 0.3, PC0=0.5)  # 0.3 s of 3 s: a tenth of the way to 0.5
        for i in range(60):
            report(s, 0.6 + 0.3 * i, PC2=0.1 + 0.76 / 2)
        assert measured(s) == pytest.approx(50.0, abs=0.01)

    run(tmp_path, SCALED + "smooth_time: 3\n" + SENSOR + "sensor_pin: v:PC2\n", body)


def test_nothing_is_reported_before_the_reference_is_known(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        report(s, 0.3, PC2=0.5, PC0=0.9)
        assert measured(s) == 0.0

    run(tmp_path, SCALED + SENSOR + "sensor_pin: v:PC2\n", body)


@pytest.mark.parametrize(
    ("readings", "words"),
    [
        # 0.85 is 94 degC, above max_temp, although the board's own limit is at 0.9
        ({"PC0": 0.9, "PC1": 0.1, "PC2": 0.85}, ("v:PC2", "0.9375", "0.9000")),
        ({"PC0": 0.1, "PC1": 0.1, "PC2": 0.5}, ("adc_scaled v", "vref_pin", "0.100")),
    ],
)
def test_a_scaled_value_that_cannot_be_stops_the_printer(
    tmp_path: Path, readings: dict[str, float], words: tuple[str, ...]
) -> None:
    def body(s: BusSession) -> None:
        for i in range(5):
            report(s, 0.3 * i, **readings)
        message, state = s.state
        assert state == "shutdown" and all(word in message for word in words), message

    run(tmp_path, SCALED + SENSOR + "sensor_pin: v:PC2\n", body)


ADS = "[ads1x1x a]\nchip: ADS1115\n"


def with_ads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: Ads1115, config: str) -> BusSession:
    """A printer that has run for 4 s with this converter."""
    attach(monkeypatch, on_i2c(device.transfer))
    session = BusSession(tmp_path, config)
    device.now = session.reactor.monotonic
    session.run(lambda s: s.sleep(4.0))
    return session


@pytest.mark.parametrize(
    ("options", "pin", "volts", "expected_c"),
    [
        ("", "AIN1", [0.0, 1.65, 0.0, 0.0], 50.0),
        ("pga: 2.048V\nadc_voltage: 2.0\n", "AIN3", [0.0, 0.0, 0.0, 0.5], 25.0),
        ("pga: 0.256V\nadc_voltage: 0.25\n", "DIFF23", [0.0, 0.0, 1.2, 1.1], 40.0),
        ("", "DIFF03", [3.0, 0.0, 0.0, 2.01], 30.0),
    ],
)
def test_an_ads1115_reads_its_inputs(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: str,
    pin: str,
    volts: list[float],
    expected_c: float,
) -> None:
    session = with_ads(tmp_path, monkeypatch, Ads1115(volts), f"{ADS}{options}{SENSOR}sensor_pin: a:{pin}\n")
    status = session.status("temperature_sensor s")
    assert status["temperature"] == pytest.approx(expected_c, abs=0.01)
    assert session.state[1] == "ready"


def test_inputs_of_an_ads1015_take_turns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = Ads1115([0.33, 0.66, 0.0, 0.0], bits=12, rates_hz=(128, 250, 490, 920, 1600, 2400, 3300, 3300))
    second = SENSOR.replace(TABLE, "").replace("sensor s]", "sensor t]")
    config = f"[ads1x1x a]\nchip: ADS1015\n{SENSOR}sensor_pin: a:AIN0\n{second}sensor_pin: a:AIN1\n"
    session = with_ads(tmp_path, monkeypatch, device, config)
    # a code is 4.096 V / 2048, 0.06 degC
    for name, expected_c in (("s", 10.0), ("t", 20.0)):
        assert session.status(f"temperature_sensor {name}")["temperature"] == pytest.approx(
            expected_c, abs=0.06
        )


def test_an_ads1115_that_is_missing_or_reads_too_hot_stops_the_printer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = f"{ADS}{SENSOR}sensor_pin: a:AIN0\n"
    device = Ads1115([3.2, 0.0, 0.0, 0.0])
    session = with_ads(tmp_path, monkeypatch, device, config)
    assert session.state[1] == "shutdown" and "a:AIN0" in session.state[0]
    device.is_there = False

    def body(s: Session) -> None:
        s.sleep(4.0)
        assert s.state[1] == "shutdown"
        assert "ads1x1x a" in s.state[0] and "i2c_address" in s.state[0]

    BusSession(tmp_path, config).run(body)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("[adc_scaled v]\nvref_pin: PC0\n", ("vssa_pin", "adc_scaled v")),
        (SCALED + "smooth_time: 0\n", ("smooth_time", "line 4")),
        (SCALED + "[output_pin o]\npin: v:PC3\n", ("v:PC3", "analog input")),
        ("[ads1x1x a]\nchip: ADS1119\n", ("chip", "ADS1119", "line 2", "ADS1115")),
        ("[ads1x1x a]\nchip: ADS1113\npga: 4.096V\n", ("pga", "line 3", "2.048V")),
        ("[ads1x1x a]\nchip: ADS1115\naddress_pin: A0\n", ("address_pin", "line 3", "SCL")),
        (f"{ADS}{SENSOR}sensor_pin: a:AIN4\n", ("AIN4", "DIFF23")),
        (f"[ads1x1x a]\nchip: ADS1114\n{SENSOR}sensor_pin: a:AIN0\n", ("AIN0", "DIFF01")),
    ],
)
def test_bad_values_are_named_with_their_place(tmp_path: Path, config: str, words: tuple[str, ...]) -> None:
    reason = start_error(tmp_path, config)
    assert all(word in reason for word in words), reason
