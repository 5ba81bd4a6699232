"""A heater the MCU switches by itself (config_onoff): set point, metering, guards."""

from __future__ import annotations

from mcu_harness import Mcu

HEATER, SENSOR = 17, 40
GROUP = 7200
LIMIT = 720_000
ON = {"oid": 1, "enable": 1, "set_point": 2000, "rising": 0, "low": 400, "high": 3900}


class Thermistor:
    """ADC code on demand."""

    def __init__(self) -> None:
        self.code = 3000  # cold

    def __call__(self, pin: int, clock: int) -> int:
        return self.code


def machine(invert: int = 0) -> tuple[Mcu, Thermistor]:
    mcu, sensor = Mcu(), Thermistor()
    mcu.run(0.001)
    mcu.adc_code = sensor
    onoff = {"oid": 1, "pin": HEATER, "analog_oid": 0, "invert": invert, "max_duration": LIMIT}
    mcu.configure(2, ("config_analog_in", {"oid": 0, "pin": SENSOR}), ("config_onoff", onoff))
    mcu.send(
        "query_analog_in", oid=0, clock=mcu.now + 1000, sample_ticks=100, sample_count=1, rest_ticks=GROUP,
        bytes_per_report=2, min_value=0, max_value=65535, range_check_count=0,
    )  # fmt: skip
    return mcu, sensor


def level(mcu: Mcu) -> int:
    return mcu.edges(HEATER)[-1][1]


def after(mcu: Mcu, sensor: Thermistor, code: int) -> int:
    sensor.code = code
    mcu.run_to(mcu.now + 2 * GROUP)
    return level(mcu)


def test_it_is_off_until_commanded_and_then_switches_at_the_reading() -> None:
    mcu, sensor = machine()
    assert after(mcu, sensor, 3000) == 0
    mcu.send("set_onoff", **ON)
    assert after(mcu, sensor, 2001) == 1
    assert after(mcu, sensor, 2000) == 0
    assert after(mcu, sensor, 2100) == 1


def test_a_sensor_that_rises_with_heat_and_an_inverted_pin() -> None:
    mcu, sensor = machine(invert=1)
    assert level(mcu) == 1  # off
    mcu.send("set_onoff", **ON | {"rising": 1})
    assert after(mcu, sensor, 1999) == 0
    assert after(mcu, sensor, 2001) == 1


def test_a_reading_outside_the_range_turns_off() -> None:
    mcu, sensor = machine()
    mcu.send("set_onoff", **ON)
    assert after(mcu, sensor, 3900) == 1
    assert after(mcu, sensor, 3901) == 0  # an open thermistor looks very cold


def test_on_time_is_metered_to_the_tick() -> None:
    mcu, sensor = machine()
    mcu.send("set_onoff", **ON)
    mcu.run_to(mcu.now + 5 * GROUP)
    sensor.code = 1000
    mcu.run_to(mcu.now + 5 * GROUP)
    edges = mcu.edges(HEATER)
    on = next(clock for clock, value in edges if value)
    off = next(clock for clock, value in edges if clock > on and not value)
    assert mcu.replies("onoff_state")[-1]["on_ticks"] == off - on > 3 * GROUP


def test_a_silent_host_is_noticed_and_the_heater_goes_off() -> None:
    mcu, _ = machine()
    mcu.send("set_onoff", **ON)
    said = mcu.now
    mcu.run_to(said + LIMIT - 2000)
    assert mcu.shutdown_reason() is None
    assert level(mcu) == 1
    mcu.run_to(said + LIMIT + 2000)
    assert mcu.shutdown_reason() == "Missed renewal of on-off set point"
    assert level(mcu) == 0


def test_a_sensor_that_stops_is_noticed() -> None:
    mcu, _ = machine()
    mcu.send("set_onoff", **ON)
    mcu.run_to(mcu.now + 3 * GROUP)
    mcu.send(
        "query_analog_in", oid=0, clock=0, sample_ticks=0, sample_count=0, rest_ticks=0, bytes_per_report=2,
        min_value=0, max_value=0, range_check_count=0,
    )  # fmt: skip
    for _ in range(3):
        mcu.run_to(mcu.now + LIMIT // 2)
        mcu.send("set_onoff", **ON)
    assert mcu.shutdown_reason() == "On-off heater without readings"
    assert level(mcu) == 0
