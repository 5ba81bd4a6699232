"""Pins and buses of the STM32F334 image: what its messages do arrives at the board outside."""

from __future__ import annotations

import pytest

from chip_rig import FREQ, Firmware
from measure import clock_offset

CS = 44  # PC12
FAN, HEATER = 38, 39  # PC6, PC7: TIM3
THERMISTOR = 4  # PA4: ADC2


def chip(*commands: tuple[str, dict[str, int]], oids: int = 1) -> Firmware:
    firmware = Firmware()
    firmware.configure(oids, *commands)
    return firmware


def test_spi_bytes_go_out_and_come_back_under_the_chip_select() -> None:
    device = chip(
        ("config_spi", {"oid": 0, "pin": CS, "cs_active_high": 0}),
        ("spi_set_bus", {"oid": 0, "spi_bus": 0, "mode": 3, "rate": 4_000_000}),
    )
    device.spi_reply = lambda bus, sent: bytes(255 - byte for byte in sent)
    answer = device.ask("spi_transfer", oid=0, data=b"\x01\x02\xfe")
    assert answer["response"] == b"\xfe\xfd\x01"
    assert [sent for _, _, _, sent in device.spi_transfers] == [b"\x01", b"\x02", b"\xfe"]
    assert {mode for _, _, mode, _ in device.spi_transfers} == {3}
    edges = device.edges(CS)
    assert [level for _, level in edges] == [1, 0, 1]
    assert edges[1][0] < device.spi_transfers[0][0] <= device.spi_transfers[-1][0] < edges[2][0]


@pytest.mark.parametrize("rate_hz", [400_000, 4_000_000])
def test_spi_is_no_faster_than_asked_for(rate_hz: int) -> None:
    device = chip(
        ("config_spi_without_cs", {"oid": 0}),
        ("spi_set_bus", {"oid": 0, "spi_bus": 0, "mode": 0, "rate": rate_hz}),
    )
    device.send("spi_send", oid=0, data=bytes(20))
    clocks = [clock for clock, _, _, _ in device.spi_transfers]
    assert len(clocks) == 20
    assert (clocks[-1] - clocks[0]) / 19 / FREQ >= 8 / rate_hz


def test_i2c_writes_and_reads_in_one_transfer() -> None:
    device = chip(
        ("config_i2c", {"oid": 0}),
        ("i2c_set_bus", {"oid": 0, "i2c_bus": 0, "rate": 100_000, "address": 0x48}),
    )
    device.i2c_reply = lambda address, wrote, count: (0, bytes(range(7, 7 + count)))
    before = device.now
    answer = device.ask("i2c_transfer", oid=0, write=b"\x12\x34", read_len=3)
    assert answer["response"] == b"\x07\x08\x09"
    assert (0, 0x48, b"\x12\x34", 3) in device.i2c_transfers
    assert answer.clock - before > 7 * 9 * FREQ // 100_000  # two addresses and five bytes at 100 kHz


def test_a_device_that_is_not_there_is_reported() -> None:
    device = chip(
        ("config_i2c", {"oid": 0}),
        ("i2c_set_bus", {"oid": 0, "i2c_bus": 0, "rate": 400_000, "address": 0x20}),
    )
    device.i2c_reply = lambda address, wrote, count: (3, bytes(count))
    answer = device.ask("i2c_transfer", oid=0, write=b"\x01", read_len=1)
    names = {
        number: name for name, number in device.dictionary.plain["enumerations"]["i2c_bus_status"].items()
    }
    assert "NACK" in names[answer["i2c_bus_status"]]


def test_hardware_pwm_has_the_duty_and_the_period_asked_for() -> None:
    device = chip(
        (
            "config_pwm_out",
            {"oid": 0, "pin": FAN, "cycle_ticks": 72000, "value": 0, "default_value": 0, "max_duration": 0},
        )
    )
    clock = device.now - clock_offset(device) + FREQ // 50
    device.send("queue_pwm_out", oid=0, clock=clock & 0xFFFFFFFF, value=64)
    device.run(0.05)
    at, pin, cycle, value = device.pwm_writes[-1]
    assert (pin, value) == (FAN, 64)
    assert cycle == pytest.approx(72000, rel=0.02)  # 255 steps of a prescaled clock
    assert at - clock_offset(device) - clock < FREQ // 100_000  # 10 us


def test_adc_reports_are_the_codes_at_the_pin() -> None:
    device = chip(("config_analog_in", {"oid": 0, "pin": THERMISTOR}))
    device.adc_code = lambda pin, clock: 1000 + pin
    clock = device.now - clock_offset(device) + FREQ // 50
    device.send(
        "query_analog_in",
        oid=0,
        clock=clock & 0xFFFFFFFF,
        sample_ticks=FREQ // 1000,
        sample_count=4,
        rest_ticks=FREQ // 20,
        bytes_per_report=2,
        min_value=0,
        max_value=16380,
        range_check_count=0,
    )
    device.run(0.3)
    states = device.replies("analog_in_state")
    assert len(states) >= 4
    values = {int.from_bytes(state["values"][:2], "little") for state in states}
    assert values == {4 * (1000 + THERMISTOR)}


def test_an_output_changes_at_its_clock() -> None:
    """Within the time one interrupt takes to begin and to find its pin."""
    device = chip(
        ("config_digital_out", {"oid": 0, "pin": 16, "value": 0, "default_value": 0, "max_duration": 0})
    )
    clock = device.now - clock_offset(device) + FREQ // 50
    device.send("queue_digital_out", oid=0, clock=clock & 0xFFFFFFFF, on_ticks=1)
    device.run(0.05)
    at, level = device.edges(16)[-1]
    assert level == 1
    assert 0 <= at - clock_offset(device) - clock < FREQ // 100_000
