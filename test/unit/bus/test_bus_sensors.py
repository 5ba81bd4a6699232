"""SPI and I2C devices and the temperature sensors on and off them, against a board with scripted answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bus_rig import FREQ, BusSession, run, start_error
from extras import bus, spi_temperature, temperature_mcu


def sensor(options: str) -> str:
    return f"[temperature_sensor s]\nmin_temp: -20\nmax_temp: 300\n{options}\n"


# ---------------------------------------------------------------- SPI converters

CHIPS: dict[str, tuple[str, list[tuple[int, float]]]] = {
    # raw values and temperatures from the data sheets' tables
    "MAX31855": (
        "",
        [(0x0640 << 16, 100.0), (0x0640 << 16 | 0x1900, 100.0), (0xFFF0 << 16, -1.0), (0xF060 << 16, -250.0)],
    ),
    "MAX6675": ("", [(0, 0.0), (400 << 3, 100.0), (0xFFF << 3, 1023.75)]),
    "MAX31856": ("", [(0x064000, 100.0), (0xFFF000, -1.0), (0x0640F0, 100.0546875), (0xF06000, -250.0)]),
    "MAX31865": (
        "rtd_nominal_r: 100\nrtd_reference_r: 400\n",
        [(0x2000 << 1, 0.0), (0x2C52 << 1, 100.0)],  # PT100 and 400 ohm
    ),
}


@pytest.mark.parametrize("kind", CHIPS)
def test_raw_values_become_the_data_sheet_s_temperatures(tmp_path: Path, kind: str) -> None:
    options, rows = CHIPS[kind]
    tolerance = 0.04 if kind == "MAX31865" else 0.0  # one step of the RTD converter is 0.03 degC

    def body(s: BusSession) -> None:
        query = next(cmd for cmd in s.chip.init if cmd.startswith("query_thermocouple"))
        oid = int(query.split("oid=")[1].split()[0])
        for raw, temp_c in rows:
            s.chip.report("thermocouple_result", oid, next_clock=10 * FREQ, value=raw, fault=0)
            assert s.status("temperature_sensor s")["temperature"] == pytest.approx(
                temp_c, abs=tolerance + 0.005
            )

    run(tmp_path, sensor(f"sensor_type: {kind}\nsensor_pin: PB1\n{options}"), body)


@pytest.mark.parametrize("kind", CHIPS)
@given(temp_c=st.floats(1.0, 340.0))
def test_every_chip_s_limits_are_where_its_readings_are(kind: str, temp_c: float) -> None:
    class Defaults:
        def getfloat(self, name: str, default: float, **_: Any) -> float:
            return default

        def getboolean(self, name: str, default: bool) -> bool:
            return default

        def getchoice(self, name: str, choices: Any, default: Any = None) -> Any:
            return default

    chip = spi_temperature.CHIPS[kind](Defaults())
    assert chip.to_temp_c(chip.to_value(temp_c)) == pytest.approx(
        temp_c, abs=0.13
    )  # half a step of 0.25 degC
    assert chip.to_value(-300.0) == 0


def test_a_converter_is_set_up_and_watched_by_the_board(tmp_path: Path) -> None:
    options = (
        "sensor_type: MAX31856\nsensor_pin: PB1\ntc_type: J\ntc_averaging_count: 4\ntc_use_50Hz_filter: yes\n"
    )

    def body(s: BusSession) -> None:
        assert "config_spi oid=0 pin=PB1 cs_active_high=0" in s.chip.config
        assert "spi_set_bus oid=0 spi_bus=spi0 mode=1 rate=4000000" in s.chip.config
        assert (
            "spi_send oid=0 data=80912200" in s.chip.init
        )  # CR0 auto, open test, 50 Hz; CR1 4 samples, type J
        assert "config_thermocouple oid=1 spi_oid=0 thermocouple_type=MAX31856" in s.chip.config
        # -20 degC is 0 (see src/thermocouple.c), 300 degC is 300 * 128 << 5
        expected = f"rest_ticks={int(0.3 * FREQ)} min_value=0 max_value={300 * 128 << 5} max_invalid_count=3"
        assert s.chip.init[-1] == f"query_thermocouple oid=1 clock=1001 {expected}"

    run(tmp_path, sensor(options), body)


def test_a_fault_is_reported_by_name_once_and_gives_no_temperature(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        for _ in range(3):
            s.chip.report("thermocouple_result", 1, next_clock=FREQ, value=0x10001, fault=1)
        s.sleep(0.1)
        faults = [line for line in s.lines if "open circuit" in line]
        assert len(faults) == 1 and "temperature_sensor s" in faults[0]
        assert s.status("temperature_sensor s")["temperature"] == 0.0

    run(tmp_path, sensor("sensor_type: MAX31855\nsensor_pin: PB1"), body)


def test_rtd_wiring_and_filter_reach_the_chip(tmp_path: Path) -> None:
    options = "sensor_type: MAX31865\nsensor_pin: PB1\nrtd_num_of_wires: 3\nrtd_use_50Hz_filter: True"

    def body(s: BusSession) -> None:
        assert "spi_send oid=0 data=80d3" in s.chip.init  # bias, automatic, 3 wires, clear faults, 50 Hz

    run(tmp_path, sensor(options), body)


# ---------------------------------------------------------------- buses


def test_software_spi_uses_the_pins_of_the_section(tmp_path: Path) -> None:
    pins = "spi_software_sclk_pin: PB2\nspi_software_mosi_pin: PB3\nspi_software_miso_pin: PB4\nspi_speed: 500000"

    def body(s: BusSession) -> None:
        assert (
            "spi_set_sw_bus oid=0 miso_pin=PB4 mosi_pin=PB3 sclk_pin=PB2 mode=0 pulse_ticks=72"
            in s.chip.config
        )

    run(tmp_path, sensor(f"sensor_type: MAX6675\nsensor_pin: PB1\n{pins}"), body)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("spi_bus: spi9", ("spi9", "spi0", "spi1")),
        ("spi_speed: 5", ("spi_speed", "100000")),
        ("spi_software_sclk_pin: PB2", ("spi_software_m",)),
        ("sensor_pin: PG1", ("PG1", "spi0")),  # the bus's own MOSI
    ],
)
def test_impossible_buses_are_explained(tmp_path: Path, options: str, words: tuple[str, ...]) -> None:
    pin = "" if "sensor_pin" in options else "sensor_pin: PB1\n"
    reason = start_error(tmp_path, sensor(f"sensor_type: MAX6675\n{pin}{options}"))
    assert all(word in reason for word in words), reason


def i2c_device(s: BusSession) -> bus.MCU_I2C:
    return bus.MCU_I2C(s.chip, None, 0x48, 100_000)


def test_an_i2c_device_reads_writes_and_names_itself_when_it_fails(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        device = i2c_device(s)
        device.i2c_write([1, 2])  # before the board is configured: at each start
        s.chip.callbacks[-1]()
        assert "i2c_transfer oid=0 write=0102 read_len=0" in s.chip.init
        assert "i2c_set_bus oid=0 i2c_bus=i2c0 rate=100000 address=72" in s.chip.config
        s.chip.answers["i2c_transfer"] = lambda data: {
            "i2c_bus_status": "SUCCESS",
            "response": b"\x07" * data[2],
        }
        assert device.i2c_read([5], 2)["response"] == b"\x07\x07"
        assert s.chip.messages("i2c_transfer") == [[0, b"\x05", 2]]
        s.chip.answers["i2c_transfer"] = lambda data: {"i2c_bus_status": "START_NACK", "response": b""}
        with pytest.raises(s.printer.command_error, match=r"address 72 .*START_NACK"):
            device.i2c_write([5])

    run(tmp_path, "", body)


def test_spi_messages_for_a_shutdown_and_transfers(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        device = bus.MCU_SPI(s.chip, "spi1", "PB7", 3, 1_000_000)
        device.setup_shutdown_msg([0xDE, 0xAD])
        s.chip.callbacks[-1]()
        assert "config_spi_shutdown oid=1 spi_oid=0 shutdown_msg=dead" in s.chip.config
        s.chip.answers["spi_transfer"] = lambda data: {"response": data[1][::-1]}
        assert device.spi_transfer([1, 2])["response"] == b"\x02\x01"
        assert device.spi_transfer_with_preface([9], [3, 4])["response"] == b"\x04\x03"
        assert [name for name, *_ in s.chip.sent] == ["spi_transfer", "spi_send", "spi_transfer"]

    run(tmp_path, "", body)


# ---------------------------------------------------------------- the board's and the host's own temperature


def test_the_host_s_temperature_is_read_once_a_second(tmp_path: Path) -> None:
    path = tmp_path / "temp"
    path.write_text("51500\n")

    def body(s: BusSession) -> None:
        s.sleep(1.5)
        assert s.status("temperature_sensor s")["temperature"] == 51.5
        assert s.status("temperature_host s")["temperature"] == 51.5
        path.write_text("broken")
        s.sleep(2.0)
        assert s.state[1] == "ready"
        path.write_text("99999000")
        s.sleep(2.0)
        assert s.state[1] == "shutdown" and "'s'" in s.state[0]

    run(tmp_path, sensor(f"sensor_type: temperature_host\nsensor_path: {path}"), body)


def test_a_host_without_that_file_is_reported(tmp_path: Path) -> None:
    reason = start_error(tmp_path, sensor("sensor_type: temperature_host\nsensor_path: /nowhere/temp"))
    assert "/nowhere/temp" in reason


TWO_POINTS = "sensor_temperature1: 20\nsensor_adc1: 0.5\nsensor_temperature2: 120\nsensor_adc2: 0.25\n"


def test_two_points_calibrate_any_board(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        pin = s.chip.pins["ADC_TEMPERATURE"]
        pin.callback(1.0, 0.375)
        assert s.status("temperature_sensor s")["temperature"] == pytest.approx(70.0)
        assert pin.setup["sample"]["minval"] == pytest.approx(0.0)  # 300 degC would be below 0
        assert pin.setup["sample"]["maxval"] == pytest.approx(0.6)  # -20 degC

    run(tmp_path, sensor(f"sensor_type: temperature_mcu\n{TWO_POINTS}"), body)


def test_an_unknown_board_needs_two_points_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(temperature_mcu, "TYPICAL", ())
    reason = start_error(tmp_path, sensor("sensor_type: temperature_mcu"))
    assert "simulator" in reason and "sensor_temperature2" in reason
    same = TWO_POINTS.replace("0.25", "0.5")
    assert "differ" in start_error(tmp_path, sensor(f"sensor_type: temperature_mcu\n{same}"))


class FakeBoard:
    """Just enough of an MCU to be asked for its factory values."""

    def __init__(self, words: dict[int, int], batch: bool = False) -> None:
        self.words, self.batch = words, batch

    def is_fileoutput(self) -> bool:
        return self.batch

    def lookup_query_command(self, *_: str) -> Any:
        board = self

        class Query:
            def send(self, data: list[int]) -> dict[str, int]:
                assert data[0] == 1, "16 bit"
                return {"val": board.words.get(data[1], 0)}

        return Query()


def line_of(
    chip: str, board: FakeBoard, points: tuple[tuple[float, float], ...] = ()
) -> temperature_mcu.Line:
    temperature = temperature_mcu.McuTemperature.__new__(temperature_mcu.McuTemperature)
    temperature.calibration = temperature_mcu.Calibration(points)
    return temperature._find_line(board, chip)


def test_factory_values_beat_typical_ones_and_one_point_shifts_the_typical_line() -> None:
    board = FakeBoard({0x1FFFF7B8: 1750, 0x1FFFF7C2: 1310})  # of an STM32F334
    line = line_of("stm32f334x8", board)
    assert line.calc_temp(1750 / 4095) == pytest.approx(30.0)
    assert line.calc_temp(1310 / 4095) == pytest.approx(110.0)
    typical = line_of("stm32f334x8", FakeBoard({}))
    assert typical.calc_temp(1.43 / 3.3) == pytest.approx(
        25.0
    )  # DS9994 table 62: 1.43 V at 25 degC, 4.3 mV/degC
    assert typical.calc_temp((1.43 - 0.43) / 3.3) == pytest.approx(125.0)
    shifted = line_of("stm32f334x8", board, ((22.0, 0.44),))
    assert shifted.calc_temp(0.44) == pytest.approx(22.0)
    assert shifted.slope_c == pytest.approx(typical.slope_c)


# ---------------------------------------------------------------- combined sensors

PAIR = """
[thermistor t]
temperature1: 25
resistance1: 100000
beta: 3950
[temperature_sensor a]
sensor_type: t
sensor_pin: PA1
[temperature_sensor b]
sensor_type: t
sensor_pin: PA2
"""
COMBINED = PAIR + sensor(
    "sensor_type: temperature_combined\nsensor_list: temperature_sensor a, temperature_sensor b\n"
    "combination_method: {method}\nmaximum_deviation: 10"
)


def ratio(temp_c: float) -> float:
    from extras import thermistor

    return thermistor.Thermistor(4700.0, 0.0, thermistor.fit_beta(25.0, 100e3, 3950.0)).calc_adc(temp_c)


@pytest.mark.parametrize(("method", "temp_c"), [("max", 58.0), ("min", 50.0), ("mean", 54.0)])
def test_combined_sensors_follow_their_method(tmp_path: Path, method: str, temp_c: float) -> None:
    def body(s: BusSession) -> None:
        s.chip.pins["PA1"].callback(1.0, ratio(50.0))
        s.chip.pins["PA2"].callback(1.0, ratio(58.0))
        s.sleep(10.0)
        assert s.state[1] == "ready"
        assert s.status("temperature_sensor s")["temperature"] == pytest.approx(temp_c, abs=0.02)

    run(tmp_path, COMBINED.replace("{method}", method), body)


def test_sensors_that_disagree_stop_the_printer_with_both_readings(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        s.chip.pins["PA1"].callback(1.0, ratio(50.0))
        s.chip.pins["PA2"].callback(1.0, ratio(61.0))
        s.sleep(10.0)
        assert s.state[1] == "shutdown"
        assert "11.0" in s.state[0] and "temperature_sensor b" in s.state[0]

    run(tmp_path, COMBINED.replace("{method}", "mean"), body)


def test_a_combined_sensor_of_something_else_is_refused(tmp_path: Path) -> None:
    config = COMBINED.replace("{method}", "max").replace(
        "sensor_list: temperature_sensor a, temperature_sensor b",
        "sensor_list: temperature_sensor a, respond",
    )
    assert "respond" in start_error(tmp_path, config)
    config = config.replace("temperature_sensor a, respond", "temperature_sensor a, temperature_sensor s")
    assert "names the section itself" in start_error(tmp_path, config)


def test_query_adc_reports_value_and_resistance(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        s.chip.pins["PA1"].last = (0.5, 12.25)
        s.gcode.run_script('QUERY_ADC\nQUERY_ADC NAME="temperature_sensor a" PULLUP=4700')
        text = "\n".join(s.lines)
        assert '"temperature_sensor a", "temperature_sensor b"' in text
        assert "0.500000 (timestamp 12.250)" in text and "resistance 4700.000" in text

    run(tmp_path, PAIR, body)
