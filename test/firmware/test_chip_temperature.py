"""The STM32F334's own temperature: a sensor on the converter that the bridge's samples come from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from chip_rig import FREQ, Firmware
from extras.temperature_mcu import Calibration, Line, McuTemperature
from measure import PERIOD, clock_offset, code_at, records_of, sampling_unit
from scenario import ROOT
from simulation.runner import PRINTED, RunOptions, Simulation

OID, SENSOR = 2, 254
THERMISTOR = 4  # PA4: ADC2
COIL = 29  # PB13: ADC1, whose sampling time is in one register with the sensor's
SUM_COUNT = 8
ADC_MAX = 4095
HALF_CODE_C = 0.5 * 80.0 / 416  # the factory's readings at 30 and 110 degC are 416 codes apart


def sensed(code: int) -> Callable[[int, int], int]:
    """What the sensor is read as; no other pin is."""
    return lambda pin, clock: code if pin == SENSOR else 0


def ask_for_values(
    device: Firmware, oid: int, sample_ticks: int, rest_s: float = 0.02, report: int = 2
) -> None:
    clock = device.now - clock_offset(device) + FREQ // 25
    device.send(
        "query_analog_in",
        oid=oid,
        clock=clock & 0xFFFFFFFF,
        sample_ticks=sample_ticks,
        sample_count=SUM_COUNT,
        rest_ticks=round(rest_s * FREQ),
        bytes_per_report=report,
        min_value=0,
        max_value=SUM_COUNT * ADC_MAX,
        range_check_count=0,
    )


def values(device: Firmware, oid: int) -> list[int]:
    states = [state for state in device.replies("analog_in_state") if state["oid"] == oid]
    return [int.from_bytes(state["values"][:2], "little") for state in states]


class Board:
    """What the host's sensor wants of an MCU, answered by the image."""

    def __init__(self, device: Firmware) -> None:
        self.device = device

    def is_fileoutput(self) -> bool:
        return False

    def lookup_query_command(self, request: str, response: str) -> Any:
        class Query:
            @staticmethod
            def send(data: list[int]) -> dict[str, int]:
                return {"val": int(self.device.ask("debug_read", order=data[0], addr=data[1])["val"])}

        return Query


def line_of(device: Firmware) -> Line:
    """The host's line from reading to temperature, with what it reads in the chip."""
    sensor = McuTemperature.__new__(McuTemperature)
    sensor.calibration = Calibration()
    return sensor._find_line(Board(device), str(device.dictionary.plain["config"]["MCU"]))


def test_the_host_reads_the_temperature_the_factory_would() -> None:
    """At the factory's two points and away from them, within half a step of the converter."""
    device = Firmware()
    device.configure(1, ("config_analog_in", {"oid": 0, "pin": SENSOR}))
    cold, hot = (
        int(device.ask("debug_read", order=1, addr=address)["val"]) for address in (0x1FFFF7B8, 0x1FFFF7C2)
    )
    assert 0.6 * ADC_MAX > cold > hot > 0.2 * ADC_MAX  # the sensor's voltage falls
    line = line_of(device)
    codes = {
        temp_c: round(cold + (hot - cold) * (temp_c - 30.0) / 80.0) for temp_c in (-20.0, 30.0, 47.0, 110.0)
    }
    for temp_c, code in codes.items():
        device.adc_code = sensed(code)
        before = len(values(device, 0))
        ask_for_values(device, 0, FREQ // 1000)
        device.run(0.11)
        read = values(device, 0)[before:]
        assert len(read) >= 2 and set(read) == {SUM_COUNT * code}
        assert line.calc_temp(read[-1] / (SUM_COUNT * ADC_MAX)) == pytest.approx(
            temp_c, abs=1.001 * HALF_CODE_C
        )


@pytest.mark.parametrize("temp_c", [28.0, 66.6])
def test_a_printer_on_the_image_reports_the_chips_temperature(tmp_path: Path, temp_c: float) -> None:
    """The model's sensor is 8 K off a typical one: without the factory's words it would show. A code of the converter
    is 0.19 K; the reading and the line through the two words are each half of one off at most."""
    config, part = tmp_path / "printer.cfg", tmp_path / "part.gcode"
    base = ROOT / "config" / "sim-f334.cfg"
    config.write_text(f"[include {base}]\n[temperature_sensor board]\nsensor_type: temperature_mcu\n")
    part.write_text("G4 P1500\n")
    overrides = (("simulator mcu", "chip_temperature", str(temp_c)),)
    run = Simulation(RunOptions(config, part, overrides=overrides, builds={"mcu": "stm32f334"}))
    outcome = run.run()
    assert outcome.status == PRINTED, outcome.reason
    sent_c = run.printer.lookup_object("temperature_sensor board").get_status(0.0)["temperature"]
    assert sent_c == pytest.approx(temp_c, abs=2 * HALF_CODE_C + 0.005)


def test_pins_and_the_sensor_take_turns() -> None:
    device = Firmware()
    device.configure(
        3,
        ("config_analog_in", {"oid": 0, "pin": THERMISTOR}),
        ("config_analog_in", {"oid": 1, "pin": SENSOR}),
        ("config_analog_in", {"oid": 2, "pin": THERMISTOR + 1}),
    )
    device.adc_code = lambda pin, clock: 1000 + pin
    for oid, ticks in ((0, 500), (1, 450), (2, 400)):
        ask_for_values(device, oid, ticks, rest_s=0.001)
    device.run(0.13)
    for oid, pin in ((0, THERMISTOR), (1, SENSOR), (2, THERMISTOR + 1)):
        read = values(device, oid)
        assert len(read) > 50 and set(read) == {SUM_COUNT * (1000 + pin)}


@pytest.mark.parametrize("first", ["bridge", "sensor"])
@pytest.mark.parametrize("period", [300, PERIOD, 1000])
def test_no_sample_of_the_bridge_is_moved_by_the_sensor(period: int, first: str) -> None:
    """At the shortest, the usual and the longest period; the sensor is asked 3000 times a second, at all places of it.
    The model of the chip objects to a conversion that meets one of the bridge's (test_emulator_objections.py)."""
    sensor = ("config_analog_in", {"oid": OID, "pin": SENSOR})
    places = {"before" if first == "sensor" else "beside": (sensor,)}
    device = sampling_unit(period=period, adc_pin=COIL, **places)
    device.adc_code = lambda pin, clock: 1700 + pin
    given: dict[int, int] = {}

    def sample(clock: int) -> int:
        given[clock] = code_at(clock)
        return given[clock]

    device.sample_code = sample
    device.send("induction_report", oid=0, enable=1)
    device.run(0.02)
    ask_for_values(device, OID, 1013, rest_s=0.002)
    device.run(0.24)
    assert device.shutdown_reason() is None
    read = values(device, OID)
    assert len(read) > 80 and set(read) == {SUM_COUNT * (1700 + SENSOR)}
    counters = device.chip.counters()
    assert counters["samples"] > 0.2 * FREQ / period and counters["samples_lost"] == 0
    if period == PERIOD:
        check_sums(device, given)


def check_sums(device: Firmware, given: dict[int, int]) -> None:
    checked = 0
    for clock, row in records_of(device, clock_offset(device), 192):
        samples = [given.get(clock + 2 + i * PERIOD) for i in range(row.count)]
        known = [s for s in samples if s is not None]
        if len(known) == row.count == 192:
            assert row.value == sum(known) >> 5 and (row.low, row.high) == (min(known), max(known))
            checked += 1
    assert checked > 80


def test_a_conversion_taken_back_leaves_nothing_behind() -> None:
    """Asked anew in the middle of a group of conversions, it gives what is there then."""
    device = sampling_unit(beside=(("config_analog_in", {"oid": OID, "pin": SENSOR}),))
    device.send("induction_report", oid=0, enable=1)
    for turn in range(40):
        ask_for_values(device, OID, 300, rest_s=0.0002, report=48)
        device.adc_code = sensed(1000 + turn)
        before = len(values(device, OID))
        device.run(0.0571 + turn * 0.37e-6)
        assert values(device, OID)[before] == SUM_COUNT * (1000 + turn)
