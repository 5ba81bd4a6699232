"""Air sensors on I2C: what the chips' data sheets say of their bytes, and what happens when a chip goes wrong."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import bus_rig
from base_rig import Session
from bus_rig import BusSession, run, start_error
from extras.sensors import i2c_temperature

Model = Callable[[bytes, int], bytes | None]  # (written, bytes wanted) -> bytes; None: no answer


class Chip:
    """Bytes by what was written last; `log` is all that was written."""

    def __init__(self, table: dict[bytes, bytes]) -> None:
        self.table = table
        self.log: list[bytes] = []

    def __call__(self, written: bytes, count: int) -> bytes | None:
        if written:
            self.log.append(written)
        answer = self.table.get(self.log[-1] if self.log else b"", b"") if count else b""
        return answer[:count] if len(answer) >= count else None


# Sensirion: CRC of 0xBEEF is 0x92; HTU21D data sheet: of 0x683A 0x7C, of 0x4E85 0x6B
SHT3X = Chip({b"\x24\x00": bytes([0x66, 0x66, 0x93, 0x80, 0x00, 0xA2])})
HTU21D = Chip({b"\xe7": b"\x02", b"\xf3": b"\x68\x3a\x7c", b"\xf5": b"\x4e\x85\x6b"})
AHT10 = Chip({b"": b"\x18", b"\xac\x33\x00": bytes([0x1C, 0x80, 0x00, 0x05, 0x80, 0x00])})
# A BME280's registers as its owner published them, who saw 24.44 degC and 54.17 %
BME280 = Chip(
    {
        b"\xd0": b"\x60",
        b"\x88": bytes.fromhex("6C6E77663200A89227D5D00B6F18CAFFF9FFAC260AD8BD10") + b"\0\x4b",
        b"\xe1": bytes.fromhex("650100140B001E"),
        b"\xf7": bytes.fromhex("553380817FB07913"),
    }
)

CASES: dict[str, tuple[Chip, str, dict[str, float]]] = {
    "LM75": (Chip({b"\x00": b"\xe7\x00"}), "lm75", {"temperature": -25.0}),
    "SHT3X": (SHT3X, "sht3x", {"temperature": 25.0, "humidity": 50.0}),
    # 0x683A: 24.686 degC; 0x4E85: 32.31 %, at 25 degC
    "HTU21D": (HTU21D, "htu21d", {"temperature": 24.69, "humidity": 32.3}),
    "SI7021": (HTU21D, "htu21d", {"temperature": 24.69, "humidity": 32.3}),
    "AHT10": (AHT10, "aht10", {"temperature": 18.75, "humidity": 50.0}),
    "BME280": (BME280, "bme280", {"temperature": 24.44, "humidity": 54.2, "pressure": 996.21}),
}


def attach(monkeypatch: pytest.MonkeyPatch, model: Model) -> None:
    """The board has this chip on its bus."""
    configure = bus_rig.Chip.configure

    def with_chip(board: bus_rig.Chip) -> None:
        def transfer(values: list[Any]) -> dict[str, Any]:
            answer = model(values[1], values[2])
            status = "SUCCESS" if answer is not None else "START_NACK"
            return {"i2c_bus_status": status, "response": answer or b""}

        board.answers["i2c_transfer"] = transfer
        configure(board)

    monkeypatch.setattr(bus_rig.Chip, "configure", with_chip)


def section(kind: str, more: str = "") -> str:
    return f"[temperature_sensor air]\nsensor_type: {kind}\ni2c_bus: i2c0\n{more}"


def wait(s: BusSession, seconds: float) -> None:
    s.reactor.pause(s.reactor.monotonic() + seconds)


@pytest.mark.parametrize("kind", CASES)
def test_a_reading_is_what_the_data_sheet_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    chip, name, expected = CASES[kind]
    attach(monkeypatch, chip)

    def body(s: BusSession) -> None:
        wait(s, 2.0)
        status = s.status(f"{name} air")
        # humidity: one step of the last digit reported
        assert status == pytest.approx(expected, abs=0.06)
        assert status.keys() == expected.keys()
        assert s.status("temperature_sensor air")["temperature"] == status["temperature"]

    run(tmp_path, section(kind), body)


def test_pressure_is_that_of_the_bmp280_data_sheet_s_example() -> None:
    chip = i2c_temperature.Bme280()
    chip.temp = (27504, 26435, -1000)
    chip.pressure = (36477, -10685, 3024, 2855, 140, -7, 15500, -14600, 6000)
    fine = chip._fine(519888)
    assert fine / 5120.0 == pytest.approx(25.08, abs=0.005)
    assert chip._pressure_pa(fine, 415148) == pytest.approx(100653.27, abs=0.01)


def test_a_bmp280_reports_no_humidity(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table = {**BME280.table, b"\xd0": b"\x58", b"\xf7": BME280.table[b"\xf7"][:6]}
    attach(monkeypatch, Chip(table))

    def body(s: BusSession) -> None:
        wait(s, 2.0)
        status = s.status("bme280 air")
        assert status["humidity"] is None and status["pressure"] == pytest.approx(996.21, abs=0.01)

    run(tmp_path, section("BME280"), body)


def test_an_htu21d_gets_its_resolution_and_keeps_its_other_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chip = Chip({**HTU21D.table, b"\xe7": b"\x3a"})
    attach(monkeypatch, chip)
    options = "htu21d_resolution: TEMP12_HUM08\n"
    run(tmp_path, section("HTU21D", options), lambda s: wait(s, 1.0))
    assert b"\xe6\x3b" in chip.log  # bits 7 and 0 are the resolution


def failing(times: int, chip: Chip) -> Model:
    left = [times]

    def model(written: bytes, count: int) -> bytes | None:
        if count and left[0]:
            left[0] -= 1
            return None
        return chip(written, count)

    return model


def test_one_lost_answer_is_made_up_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    attach(monkeypatch, failing(2, CASES["LM75"][0]))

    def body(s: BusSession) -> None:
        wait(s, 4.0)
        assert s.state[1] == "ready"
        assert s.status("lm75 air")["temperature"] == -25.0

    run(tmp_path, section("LM75"), body)


@pytest.mark.parametrize(
    ("kind", "table", "more", "reason"),
    [
        ("LM75", {}, "", "START_NACK"),
        ("SHT3X", {b"\x24\x00": b"\x66\x66\x00\x80\x00\xa2"}, "", "checksum"),
        ("BME280", {b"\xd0": b"\x61"}, "", "0x61"),
        ("AHT10", {**AHT10.table, b"\xac\x33\x00": b"\x98" + bytes(5)}, "", "busy"),
        ("LM75", {b"\x00": b"\x50\x00"}, "max_temp: 60\n", "80.0 C is outside"),
    ],
)
def test_a_sensor_that_cannot_be_trusted_stops_the_printer(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    table: dict[bytes, bytes],
    more: str,
    reason: str,
) -> None:
    attach(monkeypatch, Chip(table))

    def body(s: Session) -> None:
        s.sleep(10.0)
        message, state = s.state
        assert state == "shutdown"
        assert f"Sensor 'air' ({kind})" in message and reason in message

    BusSession(tmp_path, section(kind, more)).run(body)  # some stop before they are ready


def test_a_wrong_option_is_named(tmp_path: Path) -> None:
    reason = start_error(tmp_path, section("HTU21D", "htu21d_resolution: FINE\n"))
    assert "htu21d_resolution" in reason and "FINE" in reason
    assert "aht10_report_time" in start_error(tmp_path, section("AHT10", "aht10_report_time: 1\n"))
