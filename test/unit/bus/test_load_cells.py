"""Load cells and eddy probes without a machine: what the config sends to the board, and what it refuses."""

from __future__ import annotations

import math
import random
from pathlib import Path
from types import SimpleNamespace

import pytest

from bus_devices import frames
from bus_rig import BusSession, run, start_error
from extras.accelerometer.bulk import BulkReader
from extras.eddy.curve import Curve
from extras.eddy.drift import Drift, fit, value
from extras.load_cells.chips import unpack
from extras.load_cells.contact import find_contact
from extras.probing.analog_endstop import ERROR_REASON, AnalogEndstop
from extras.probing.filters import Scale, high_pass, low_pass, notch

HX711 = "[load_cell]\nsensor_type: hx711\ndout_pin: PA1\nsclk_pin: PA2\n"
ADS1220 = "[load_cell]\nsensor_type: ads1220\ncs_pin: PA1\ndata_ready_pin: PA2\n"
ADS131 = "[load_cell]\nsensor_type: ads131m04\ncs_pin: PA1\ndata_ready_pin: PA2\nclock_freq: 8192000\n"
EDDY = "[probe_eddy_current e]\nsensor_type: ldc1612\ndescend_z: 0.5\n"


def configured(tmp_path: Path, config: str) -> list[str]:
    found: list[str] = []
    run(tmp_path, config, lambda s: found.extend(s.chip.config), debugoutput="x")
    return found


@pytest.mark.parametrize(
    ("kind", "gain", "pulses"),
    [
        ("hx711", "A-128", 1),
        ("hx711", "B-32", 2),
        ("hx711", "A-64", 3),
        ("hx717", "B-8", 4),
        ("hx717", "B-64", 2),
    ],
)
def test_the_pulses_after_the_bits_choose_gain_and_input(
    tmp_path: Path, kind: str, gain: str, pulses: int
) -> None:
    commands = configured(tmp_path, HX711.replace("hx711", kind) + f"gain: {gain}\n")
    assert f"config_hx71x oid=0 gain_channel={pulses} dout_pin=PA1 sclk_pin=PA2" in commands


class Ads1220Registers:
    """WREG and RREG of the data sheet."""

    def __init__(self) -> None:
        self.registers = bytearray(4)

    def answer(self, values: list[object]) -> dict[str, bytes]:
        data = bytes(values[1])  # type: ignore[arg-type]
        if data[0] & 0xF0 == 0x40:
            self.registers[data[0] >> 2 & 3 :][: len(data) - 1] = data[1:]
            self.registers = bytearray(data[1:])
        return {"response": bytes([0, *self.registers])}


def test_an_ads1220_is_set_read_back_and_started(tmp_path: Path) -> None:
    """660 samples a second are the turbo mode; AIN1 and AIN2, gain 64, its own reference."""
    chip = Ads1220Registers()

    def body(s: BusSession) -> None:
        s.chip.answers["spi_send"] = chip.answer
        s.chip.answers["spi_transfer"] = chip.answer
        s.printer.lookup_object("load_cell").chip.prepare()
        sent = frames(s.chip, 0)
        assert sent[0] == b"\x06" and sent[-1] == b"\x08", "reset first, start last"
        assert bytes(chip.registers) == bytes([3 << 4 | 6 << 1, 4 << 5 | 2 << 3 | 4, 0, 0])

    run(tmp_path, ADS1220 + "gain: 64\ninput_mux: AIN1_AIN2\n", body, debugoutput="x")


def test_the_gain_amplifier_is_bypassed_against_ground(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        assert s.printer.lookup_object("load_cell").chip._registers[0] == 9 << 4 | 1

    run(tmp_path, ADS1220 + "gain: 1\ninput_mux: AIN1_AVSS\n", body, debugoutput="x")


@pytest.mark.parametrize(
    ("options", "rate_hz"),
    [("", 500.0), ("sample_rate: 64000\n", 64000.0), ("sample_rate: 300\n", 250.0)],
)
def test_an_ads131_has_the_nearest_rate(tmp_path: Path, options: str, rate_hz: float) -> None:
    def body(s: BusSession) -> None:
        assert s.printer.lookup_object("load_cell").chip.rate_hz == pytest.approx(rate_hz)

    run(tmp_path, ADS131 + options, body, debugoutput="x")


def test_an_ads131_may_have_its_clock_from_the_board(tmp_path: Path) -> None:
    config = (
        ADS131.replace("clock_freq: 8192000", "pwm_clock: adc")
        + "[static_pwm_clock adc]\npin: PA5\nfrequency: 4096000\n"
    )

    def body(s: BusSession) -> None:
        assert s.printer.lookup_object("load_cell").chip.rate_hz == pytest.approx(500.0)

    run(tmp_path, config, body, debugoutput="x")


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (HX711 + "gain: B-8\n", ("gain", "load_cell", "line 5", "A-128")),
        (HX711 + "sample_rate: 320\n", ("sample_rate", "line 5", "80")),
        (HX711.replace("hx711", "hx712"), ("sensor_type", "line 2", "hx717")),
        (ADS1220 + "sample_rate: 100\n", ("sample_rate", "line 5", "660")),
        (ADS131 + "adc_channel: 4\n", ("adc_channel", "line 6", "3")),
        (ADS131.replace("clock_freq: 8192000\n", ""), ("clock_freq", "load_cell")),
        (HX711 + "counts_per_gram: 0\n", ("counts_per_gram", "line 5")),
        (
            HX711.replace("[load_cell]", "[load_cell_probe]")
            + "z_offset: 0\nnotch_filter_frequencies: 50, 60, 70\n",
            ("notch_filter_frequencies", "line 6", "2"),
        ),
        (
            HX711.replace("[load_cell]", "[load_cell_probe]")
            + "z_offset: 0\nbuzz_filter_cutoff_frequency: 50\n",
            ("buzz_filter_cutoff_frequency", "line 6", "40"),
        ),
        (EDDY.replace("ldc1612", "ldc1614"), ("sensor_type", "probe_eddy_current e", "line 2")),
        (EDDY.replace("descend_z: 0.5\n", ""), ("descend_z", "probe_eddy_current e")),
        (EDDY + "frequency: 2000000\nmax_sensor_hz: 9000000\n", ("max_sensor_hz", "line 5", "2000000 Hz")),
        (EDDY + "calibrate: 0.1:3.2, 0.2:3.1\n", ("calibrate", "line 4", "PROBE_EDDY_CURRENT_CALIBRATE")),
        (EDDY + "drift_calibration: 1, 2, 3\n", ("drift_calibration", "line 4", "calibration_temp")),
    ],
)
def test_bad_values_are_named_with_their_place(tmp_path: Path, config: str, words: tuple[str, ...]) -> None:
    reason = start_error(tmp_path, config)
    assert all(word in reason for word in words), reason


def test_the_older_name_of_the_height_still_counts(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        assert s.printer.lookup_object("probe").get_offsets()[2] == 0.7

    run(tmp_path, EDDY.replace("descend_z: 0.5", "z_offset: 0.7"), body, debugoutput="x")


def test_samples_are_read_from_messages_and_a_gap_is_counted(tmp_path: Path) -> None:
    samples: list[float | None] = []

    def body(s: BusSession) -> None:
        reader = BulkReader(s.chip, 7, 2, 4)
        reader.build(s.chip.lookup_query_command("query_hx71x_status oid=%c", "sensor_bulk_status"))
        reader.start(80.0)
        s.chip.answers["query_hx71x_status"] = lambda values: {
            "clock": 1000, "query_ticks": 10, "next_sequence": 302, "buffered": 0, "possible_overflows": 0,
        }  # fmt: skip
        for sequence, counts in ((0, (5, -6)), (301, (-(1 << 23), 7))):
            data = b"".join(value.to_bytes(4, "little", signed=True) for value in counts)
            s.chip.report("sensor_bulk_data", 7, sequence=sequence, data=data)
        assert reader.update() == 604
        reader.take(lambda raw, print_time: samples.append(unpack(raw)))
        assert reader.lost_messages == 300

    run(tmp_path, HX711, body, debugoutput="x")
    assert samples == [5.0, -6.0, -8388608.0, 7.0]


# ---- computing ---------------------------------------------------------------------------------------------


def gain_db(section: tuple[float, ...], share: float) -> float:
    """At a share of the sampling rate."""
    b0, b1, b2, a1, a2 = section
    z = complex(math.cos(2 * math.pi * share), -math.sin(2 * math.pi * share))
    return 20.0 * math.log10(abs((b0 + b1 * z + b2 * z * z) / (1.0 + a1 * z + a2 * z * z)))


@pytest.mark.parametrize("order", [1, 2])
def test_butterworth_filters_have_3_db_at_their_frequency(order: int) -> None:
    low, high = low_pass(50.0, 500.0, order), high_pass(50.0, 500.0, order)
    assert gain_db(low, 0.1) == pytest.approx(-3.01, abs=0.01)
    assert gain_db(high, 0.1) == pytest.approx(-3.01, abs=0.01)
    assert gain_db(low, 0.0001) == pytest.approx(0.0, abs=0.01)
    assert gain_db(high, 0.4999) == pytest.approx(0.0, abs=0.01)
    assert gain_db(low, 0.4) < -18.0 * order


def test_a_notch_takes_out_its_frequency_and_little_else() -> None:
    section = notch(50.0, 500.0, 2.0)
    assert gain_db(section, 0.1001) < -40.0
    # half its width at 3 dB is f / (2 Q): 12 Hz on either side
    assert gain_db(section, 0.02) > -1.0 and gain_db(section, 0.3) > -1.0


def test_a_scale_is_sent_as_fine_as_it_fits() -> None:
    scale, bits = Scale(factor=16384.0 / 500.0).fixed()
    assert scale / (1 << bits) == pytest.approx(16384.0 / 500.0, rel=1e-8)
    assert abs(scale) < 1 << 31


@pytest.mark.parametrize("seed", range(5))
def test_the_corner_of_a_noisy_line_is_found(seed: int) -> None:
    """60 samples of 0.5 g: 0.3 um of standard deviation."""
    noise = random.Random(seed)
    points = []
    for i in range(60):
        z = 0.1 - 0.003 * i
        force = 12.0 + 1000.0 * max(0.0, 0.0123 - z) + noise.gauss(0.0, 0.5)
        points.append((z, force))
    found = find_contact(points)
    assert found is not None and found == pytest.approx(0.0123, abs=0.002)


def test_without_a_corner_there_is_no_contact() -> None:
    assert find_contact([(0.01 * i, 5.0) for i in range(20)]) is None
    assert find_contact([(0.0, 1.0)] * 4) is None


def test_a_curve_is_read_as_it_was_written() -> None:
    points = [(0.1 * i, 3e6 * (1.0 + 0.1 * math.exp(-0.1 * i))) for i in range(1, 30)]
    curve = Curve(points)
    pairs = [tuple(map(float, pair.split(":"))) for pair in curve.text().split(",")]
    again = Curve([(height, hz) for height, hz in pairs])
    for height in (0.15, 1.0, 2.4):
        assert again.height_mm(curve.hz(height)) == pytest.approx(height, abs=1e-5)
    assert curve.range_mm == pytest.approx((0.1, 2.9))


def test_a_curve_that_does_not_fall_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fall"):
        Curve([(1.0, 5.0), (2.0, 4.0), (3.0, 4.5), (4.0, 3.0), (5.0, 2.0)])


def test_a_parabola_goes_through_its_points() -> None:
    samples = [(t, 3e6 - 120.0 * t + 0.3 * t * t) for t in (25.0, 40.0, 60.0, 80.0)]
    found = fit(samples)
    assert value(found, 50.0) == pytest.approx(3e6 - 6000.0 + 750.0, abs=0.01)


def test_drift_is_taken_out_between_the_heights_too() -> None:
    def hz(height: float, temp_c: float) -> float:
        near = math.exp(-height / 2.0)
        return 3e6 * (1.0 + 0.05 * near) * (1.0 + (temp_c - 25.0) * (-4e-5 + 2e-5 * near))

    parabolas = [fit([(t, hz(h, t)) for t in (20.0, 40.0, 60.0, 80.0)]) for h in (0.25, 0.5, 1.0, 2.0, 4.0)]
    drift = Drift(parabolas, 25.0)
    for height in (0.3, 0.7, 3.0):
        # 50 kHz a millimetre: 5 Hz are 0.1 um
        assert drift.corrected(hz(height, 75.0), 75.0) == pytest.approx(hz(height, 25.0), abs=60.0)
        assert drift.expected(hz(height, 25.0), 75.0) == pytest.approx(hz(height, 75.0), abs=60.0)


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0, "the reading is beyond its safe range"),
        (1, "the filter has overflowed"),
        (2, "no data from the sensor in time"),
        (4, "the sensor reports damaged data"),
        (5, "the sensor reports that it has been reset"),
    ],
)
def test_what_stops_a_move_is_named_by_the_numbers_of_stock_boards(
    tmp_path: Path, code: int, text: str
) -> None:
    """trigger_analog_error: RAW_RANGE 0 to SENSOR_SPECIFIC 3; ads131m0x_error: CRC 1, RESET 2."""

    def body(s: BusSession) -> None:
        endstop = AnalogEndstop(s.chip, 4, "ads131m0x_error:")
        s.chip.callbacks[-1]()
        endstop._dispatch = SimpleNamespace(wait_end=lambda time: None, stop=lambda: ERROR_REASON + code)  # type: ignore[assignment]
        with pytest.raises(s.printer.command_error, match=text):
            endstop.home_wait(1.0)

    run(tmp_path, "", body)
