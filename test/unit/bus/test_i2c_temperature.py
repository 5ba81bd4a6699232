"""Air sensors on I2C: what the chips' data sheets say of their bytes, and what happens when a chip goes wrong."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import bus_rig
from base_rig import Session
from bus_rig import BusSession, run, start_error
from extras.sensors import bosch

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
AHT_CRC = 0xA7
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

# An AHT30 has its calibration at once and adds a checksum; here to the reading of the AHT10
AHT30 = Chip({b"": b"\x18", b"\xac\x33\x00": bytes([0x1C, 0x80, 0x00, 0x05, 0x80, 0x00, AHT_CRC])})
# The example of the BMP180's data sheet: 15.0 degC, 699.64 hPa, oversampling 0
BMP180_CALIBRATION = (408, -72, -14383, 32741, 32757, 23153, 6190, 4, -32768, -8711, 2868)
BMP180 = Chip(
    {
        b"\xd0": b"\x55",
        b"\xaa": b"".join(value.to_bytes(3, "big", signed=True)[1:] for value in BMP180_CALIBRATION),
        b"\xf6": (27898).to_bytes(2, "big") + b"\0",
    }
)
# T1 = 27000 * 2^8, T2 = 18000 / 2^30: (8400000 - 6912000) * T2 = 24.945 degC. P5 = 25000 * 8, P6 = 640 / 2^6,
# P1 = -4000 / 2^20, P9 = 200 / 2^48: 200000 + 10 * 24.945 - 22888.18 + 25.58 = 177386.8 Pa
BMP388 = Chip(
    {
        b"\xd0": b"\0",
        b"\x00": b"\x50",
        b"\x31": struct.pack(
            "<HHbhhbbHHbbhbb", 27000, 18000, 0, 12384, 16384, 0, 0, 25000, 640, 0, 0, 200, 0, 0
        ),
        b"\x04": (6000000).to_bytes(3, "little") + (8400000).to_bytes(3, "little"),
    }
)

CASES: dict[str, tuple[Chip, str, dict[str, float | None]]] = {
    "LM75": (Chip({b"\x00": b"\xe7\x00"}), "lm75", {"temperature": -25.0}),
    "SHT3X": (SHT3X, "sht3x", {"temperature": 25.0, "humidity": 50.0}),
    # 0x683A: 24.686 degC; 0x4E85: 32.31 %, at 25 degC
    "HTU21D": (HTU21D, "htu21d", {"temperature": 24.69, "humidity": 32.3}),
    "SI7021": (HTU21D, "htu21d", {"temperature": 24.69, "humidity": 32.3}),
    "AHT10": (AHT10, "aht10", {"temperature": 18.75, "humidity": 50.0}),
    "AHT1X": (AHT10, "aht10", {"temperature": 18.75, "humidity": 50.0}),
    "AHT3X": (AHT30, "aht10", {"temperature": 18.75, "humidity": 50.0}),
    "BME280": (BME280, "bme280", {"temperature": 24.44, "humidity": 54.2, "pressure": 996.21, "gas": None}),
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
    chip = bosch.Bme280(False)
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


def test_a_bmp180_works_out_the_example_of_its_data_sheet() -> None:
    chip = bosch.Bmp180(BMP180_CALIBRATION)
    assert chip.compensate(27898, 23843, 0) == (150, 69964)


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        # raw pressure 27898 << 1: no example, only the way to it
        (BMP180.table, {"temperature": 15.0, "humidity": None}),
        (BMP388.table, {"temperature": 24.94, "humidity": None, "pressure": 1773.87}),
    ],
)
def test_chips_of_bosch_are_known_by_their_ids(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    table: dict[bytes, bytes],
    expected: dict[str, float | None],
) -> None:
    attach(monkeypatch, Chip(table))

    def body(s: BusSession) -> None:
        wait(s, 2.0)
        status = s.status("bme280 air")
        assert {name: status[name] for name in expected} == pytest.approx(expected, abs=0.006)
        assert status["gas"] is None

    run(tmp_path, section("BME280"), body)


T1, T2, T3 = 26041, 26469, 3
P = (36673, -10515, 88, 7310, -130, 30, 46, -2424, -2443, 30)
H = (703, 1023, 0, 45, 20, 120, -100)
RAW_TEMP, RAW_PRESSURE, RAW_HUMIDITY, RAW_GAS = 495000, 340000, 21000, 700


def bme680_by_integers() -> tuple[int, int, int]:
    """0.01 degC, Pa and 0.001 %: the data sheet's other version, chapter 3.3, in integers."""
    v1 = (RAW_TEMP >> 3) - (T1 << 1)
    fine = (v1 * T2 >> 11) + ((((v1 >> 1) ** 2 >> 12) * (T3 << 4)) >> 14)
    temp = fine * 5 + 128 >> 8
    p1, p2, p3, p4, p5, p6, p7, p8, p9, p10 = P
    v1 = (fine >> 1) - 64000
    v2 = ((((v1 >> 2) ** 2 >> 11) * p6) >> 2) + (v1 * p5 << 1)
    v2 = (v2 >> 2) + (p4 << 16)
    v1 = (((((v1 >> 2) ** 2 >> 13) * (p3 << 5)) >> 3) + (p2 * v1 >> 1)) >> 18
    v1 = (32768 + v1) * p1 >> 15
    pressure = (1048576 - RAW_PRESSURE - (v2 >> 12)) * 3125
    pressure = pressure // v1 << 1 if pressure >= 1 << 30 else (pressure << 1) // v1
    v1 = p9 * ((pressure >> 3) ** 2 >> 13) >> 12
    v2 = (pressure >> 2) * p8 >> 13
    pressure += v1 + v2 + ((pressure >> 8) ** 3 * p10 >> 17) + (p7 << 7) >> 4
    h1, h2, h3, h4, h5, h6, h7 = H
    v1 = RAW_HUMIDITY - (h1 << 4) - (temp * h3 // 100 >> 1)
    v2 = h2 * (temp * h4 // 100 + ((temp * (temp * h5 // 100) >> 6) // 100) + (1 << 14)) >> 10
    v3 = v1 * v2
    v4 = ((h6 << 7) + temp * h7 // 100) >> 4
    return temp, pressure, ((v3 + (v4 * ((v3 >> 14) ** 2 >> 10) >> 1) >> 10) * 1000) >> 12


def bme680() -> Chip:
    """Registers with this calibration and these readings; gas range 4, valid and stable."""
    low, high, data = bytearray(25), bytearray(16), bytearray(15)
    struct.pack_into("<hb", low, 1, T2, T3)
    struct.pack_into("<Hhb", low, 5, *P[:3])
    struct.pack_into("<hhbb", low, 11, P[3], P[4], P[6], P[5])
    struct.pack_into("<hhB", low, 19, *P[7:])
    high[0:3] = bytes([H[1] >> 4, (H[1] & 15) << 4 | H[0] & 15, H[0] >> 4])
    struct.pack_into("<bbbBb", high, 3, *H[2:])
    struct.pack_into("<Hhbb", high, 8, T1, -5969, -30, 18)  # t1, g2, g1, g3
    data[0] = 0x80
    data[2:5] = (RAW_PRESSURE << 4).to_bytes(3, "big")
    data[5:8] = (RAW_TEMP << 4).to_bytes(3, "big")
    data[8:10] = RAW_HUMIDITY.to_bytes(2, "big")
    data[13:15] = (RAW_GAS << 6 | 0x30 | 4).to_bytes(2, "big")
    return Chip(
        {b"\xd0": b"\x61", b"\x89": bytes(low), b"\xe1": bytes(high), b"\x1d": bytes(data), b"\x00": b"\x2d",
         b"\x02": b"\x16", b"\x04": b"\xf3"}
    )  # fmt: skip


def test_a_bme680_agrees_with_the_other_version_of_its_data_sheet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chip = bme680()
    attach(monkeypatch, chip)
    temp, pressure, humidity = bme680_by_integers()

    def body(s: BusSession) -> None:
        wait(s, 0.5)
        assert s.status("bme280 air")["gas"] is None, "its heater first needs the air's temperature"
        wait(s, 2.0)
        status = s.status("bme280 air")
        # the integers are cut off at each step
        assert status["temperature"] == pytest.approx(temp / 100.0, abs=0.015)
        assert status["pressure"] == pytest.approx(pressure / 100.0, abs=0.1)
        assert status["humidity"] == pytest.approx(humidity / 1000.0, abs=0.1)
        # (1340 - 5) * 499500.5 / (700 - 512 + 1335)
        assert status["gas"] == pytest.approx(437842.0, abs=1.0)

    run(tmp_path, section("BME280"), body)
    gas_runs = [data for data in chip.log if data[0] == 0x71 and data[1:] == b"\x10"]
    assert len(gas_runs) == 1
    heater = next(data[1] for data in chip.log if data[0] == 0x5A and len(data) == 2)
    # 300 degC: 3.4 * (((-30 / 16 + 49) * (1 + 0.0022589 * 300) + 18 / 1024 * 24) * 4 / 5 / 1.09 - 25) = 113
    assert heater == pytest.approx(113, abs=1)


def test_an_aht3x_with_a_wrong_checksum_stops_the_printer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = {**AHT30.table, b"\xac\x33\x00": AHT30.table[b"\xac\x33\x00"][:6] + b"\0"}
    attach(monkeypatch, Chip(table))

    def body(s: Session) -> None:
        s.sleep(10.0)
        assert s.state[1] == "shutdown" and "checksum" in s.state[0]

    BusSession(tmp_path, section("AHT3X")).run(body)


def test_a_ds18b20_is_read_and_watched_by_the_linux_board(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = "[temperature_sensor air]\nsensor_type: DS18B20\nserial_no: 28-031674b175ff\nsensor_mcu: mcu\n"
    config += "min_temp: -10\nmax_temp: 60.5\n"

    def body(s: BusSession) -> None:
        serial = b"28-031674b175ff".hex()
        assert f"config_ds18b20 oid=0 serial={serial} max_error_count=4" in s.chip.config
        assert s.chip.init[0].endswith(f"rest_ticks={3 * bus_rig.FREQ} min_value=-10000 max_value=60500")
        s.chip.report("ds18b20_result", 0, next_clock=10 * bus_rig.FREQ, value=21437, fault=0)
        assert s.status("temperature_sensor air")["temperature"] == pytest.approx(21.44)
        s.chip.report("ds18b20_result", 0, next_clock=13 * bus_rig.FREQ, value=0, fault=1)
        assert s.status("temperature_sensor air")["temperature"] == pytest.approx(21.44)
        assert "28-031674b175ff" in caplog.text

    run(tmp_path, config, body)


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
        ("BME280", {b"\xd0": b"\x62", b"\x00": b"\0"}, "", "0x62"),
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
    ds18b20 = "[temperature_sensor air]\nsensor_type: DS18B20\nsensor_mcu: host\nserial_no: 28-0\n"
    for text, words in (
        (ds18b20, ("sensor_mcu", "[mcu host]", "line 3")),
        (ds18b20.replace("host", "mcu") + "ds18_report_time: 0.5\n", ("ds18_report_time", "line 5")),
        (ds18b20.replace("serial_no: 28-0\n", ""), ("serial_no",)),
    ):
        reason = start_error(tmp_path, text)
        assert all(word in reason for word in words), reason
    assert "aht10_report_time" in start_error(tmp_path, section("AHT10", "aht10_report_time: 1\n"))
