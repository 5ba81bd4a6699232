"""Filters, analog trigger and sensors of measuring probes on the simulated MCU: the chips' bits in, triggers out."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import pytest

from mcu_harness import FREQ, Mcu

MS = FREQ // 1000
FILTER, TRSYNC, TRIGGER, CELL = 0, 1, 2, 3
DOUT, SCLK = 16, 17
PERIOD = 5 * MS
TRIGGERED, ERROR = 1, 16
BITS = 29


class Hx711:
    """A conversion at the end of each period; DOUT and SCLK as in the data sheet: 24 bits, then pulses for the gain."""

    def __init__(self, mcu: Mcu, values: Sequence[int]) -> None:
        self.mcu, self.values, self.start = mcu, values, mcu.now
        self.taken, self.seen = -1, 0
        self.pulses: list[int] = []
        self.code = 0
        mcu.input_level = self.level

    def _newest(self, clock: int) -> int:
        return min((clock - self.start) // PERIOD - 1, len(self.values) - 1)

    def _count_pulses(self, clock: int) -> None:
        rising = [at for at, level in self.mcu.edges(SCLK) if level]
        for at in rising[self.seen :]:
            if self._newest(at) > self.taken:
                self.taken = self._newest(at)
                self.code = self.values[self.taken] & 0xFFFFFF
                self.pulses.append(0)
            self.pulses[-1] += 1
        self.seen = len(rising)

    def level(self, pin: int, clock: int) -> int:
        if pin != DOUT:
            return 0
        self._count_pulses(clock)
        if self._newest(clock) > self.taken:
            return 0
        pulses = self.pulses[-1] if self.pulses else 25
        return self.code >> 24 - pulses & 1 if pulses <= 24 else 1


def cell_board(gain: int = 1) -> Mcu:
    mcu = Mcu()
    mcu.configure(
        4,
        ("config_sos_filter", {"oid": FILTER, "max_sections": 2}),
        ("config_trsync", {"oid": TRSYNC}),
        ("config_trigger_analog", {"oid": TRIGGER, "sos_filter_oid": FILTER}),
        ("config_hx71x", {"oid": CELL, "gain_channel": gain, "dout_pin": DOUT, "sclk_pin": SCLK}),
        ("hx71x_attach_trigger_analog", {"oid": CELL, "trigger_analog_oid": TRIGGER}),
    )
    return mcu


def home(mcu: Mcu, kind: int, value: int, **limits: int) -> None:
    """Filter as set so far; the monitor allows three periods."""
    low, high = limits.get("low", -(1 << 30)), limits.get("high", 1 << 30)
    mcu.send("trigger_analog_set_raw_range", oid=TRIGGER, raw_min=low, raw_max=high)
    mcu.send("trigger_analog_set_trigger", oid=TRIGGER, trigger_analog_type=kind, trigger_value=value)
    mcu.send("trsync_start", oid=TRSYNC, report_clock=0, report_ticks=0, expire_reason=4)
    mcu.send(
        "trigger_analog_home", oid=TRIGGER, trsync_oid=TRSYNC, trigger_reason=TRIGGERED, error_reason=ERROR,
        clock=mcu.now & 0xFFFFFFFF, monitor_ticks=PERIOD, monitor_max=3,
    )  # fmt: skip


def reason(mcu: Mcu) -> int:
    """Why the trsync has stopped; 2: it had not, until now."""
    return int(mcu.ask("trsync_trigger", oid=TRSYNC, reason=2)["trigger_reason"])


def samples(mcu: Mcu) -> list[int]:
    data = b"".join(m["data"] for m in mcu.replies("sensor_bulk_data"))
    return [int.from_bytes(data[at : at + 4], "little", signed=True) for at in range(0, len(data), 4)]


@pytest.mark.parametrize(("gain", "pulses"), [(1, 25), (2, 26), (3, 27)])
def test_an_hx711_is_read_bit_by_bit_and_asked_for_its_gain(gain: int, pulses: int) -> None:
    mcu = cell_board(gain)
    values = [0, 1, -1, 8388607, -8388608, 123456, -654321, 7, 8, 9, 10, 11, 12]
    chip = Hx711(mcu, values)
    mcu.send("query_hx71x", oid=CELL, rest_ticks=MS // 2)
    mcu.run(0.005 * 14)
    assert samples(mcu) == values
    assert set(chip.pulses) == {pulses}


def test_no_pulse_of_the_clock_is_long_enough_to_reset_the_chip() -> None:
    mcu = cell_board()
    Hx711(mcu, [5] * 4)
    mcu.send("query_hx71x", oid=CELL, rest_ticks=MS // 2)
    mcu.run(0.02)
    edges = mcu.edges(SCLK)
    high = [end - begin for (begin, level), (end, _) in pairwise(edges) if level]
    assert high and max(high) < 50e-6 * FREQ


@pytest.mark.parametrize(
    ("kind", "value", "values", "stops"),
    [
        (0, 100, [0, 50, -99, -100], True),
        (0, 100, [0, 99, -99, 99], False),
        (1, 100, [0, -500, 100, 101], True),
        (1, 100, [0, -500, 100, 100], False),
        (2, 100, [0, 300, 250, 199], True),
        (2, 100, [0, 300, 250, 200], False),
    ],
)
def test_each_type_of_trigger_stops_at_its_value(
    kind: int, value: int, values: list[int], stops: bool
) -> None:
    mcu = cell_board()
    Hx711(mcu, values)
    mcu.send("query_hx71x", oid=CELL, rest_ticks=MS // 2)
    home(mcu, kind, value)
    mcu.run(0.005 * 4 + 0.002)
    assert mcu.ask("trigger_analog_query_state", oid=TRIGGER)["homing"] == int(not stops)
    assert reason(mcu) == (TRIGGERED if stops else 2)


def test_the_clock_of_the_trigger_is_that_of_the_sample() -> None:
    mcu = cell_board()
    chip = Hx711(mcu, [0, 0, 500])
    mcu.send("query_hx71x", oid=CELL, rest_ticks=MS // 10)
    home(mcu, 1, 100)
    mcu.run(0.02)
    clock = mcu.ask("trigger_analog_query_state", oid=TRIGGER)["homing_clock"]
    late = (clock - (chip.start + 3 * PERIOD)) & 0xFFFFFFFF
    assert late < 0.3 * MS  # a look, and the reading


@pytest.mark.parametrize(
    ("values", "limits", "code"),
    [
        ([0, 2000], {"high": 1000}, 0),
        ([0, -2000], {"low": -1000}, 0),
        ([0, 0], {}, 2),  # then silence
    ],
)
def test_a_reading_out_of_range_and_silence_are_errors(
    values: list[int], limits: dict[str, int], code: int
) -> None:
    mcu = cell_board()
    Hx711(mcu, values)
    mcu.send("query_hx71x", oid=CELL, rest_ticks=MS // 2)
    home(mcu, 0, 1 << 29, **limits)
    mcu.run(0.005 * 8)
    assert reason(mcu) == ERROR + code


def test_a_filter_that_overflows_is_an_error() -> None:
    mcu = cell_board()
    mcu.send(
        "sos_filter_set_offset_scale", oid=FILTER, offset=0, scale=1 << 20, scale_frac_bits=0, auto_offset=0
    )
    Hx711(mcu, [0, 5000])
    mcu.send("query_hx71x", oid=CELL, rest_ticks=MS // 2)
    home(mcu, 0, 1 << 30)
    mcu.run(0.015)
    assert reason(mcu) == ERROR + 1


def set_section(mcu: Mcu, number: int, coefficients: Sequence[float]) -> None:
    values = {f"sos{i}": round(c * (1 << BITS)) for i, c in enumerate(coefficients)}
    mcu.send("sos_filter_set_section", oid=FILTER, section_idx=number, **values)


def filtered(
    values: Sequence[int], sections: Sequence[Sequence[float]], offset: float, scale: float
) -> list[float]:
    """The same in floating point, by the plain difference equation."""
    x = [(value - offset) * scale for value in values]
    for b0, b1, b2, a1, a2 in sections:
        y: list[float] = []
        for i in range(len(x)):
            past = [(x[i - k] if i >= k else 0.0, y[i - k] if i >= k else 0.0) for k in (1, 2)]
            y.append(b0 * x[i] + b1 * past[0][0] + b2 * past[1][0] - a1 * past[0][1] - a2 * past[1][1])
        x = y
    return x


def test_the_filter_is_that_of_the_difference_equation() -> None:
    """Through the trigger: it must stop at the sample at which the plain calculation passes the value."""
    low = (0.0675, 0.1349, 0.0675, -1.143, 0.4128)
    high = (0.98, -1.96, 0.98, -1.9596, 0.9604)
    values = [1000] * 5 + [1000 + 40 * i for i in range(20)]
    plain = filtered(values, (high, low), 1000, 64.0)
    for at in (8, 12, 17):
        threshold = round(0.5 * (plain[at - 1] + plain[at]))
        expected = next(i for i, y in enumerate(plain) if y > threshold)
        mcu = cell_board()
        mcu.send(
            "sos_filter_set_offset_scale",
            oid=FILTER,
            offset=1000,
            scale=128,
            scale_frac_bits=1,
            auto_offset=0,
        )
        set_section(mcu, 0, high)
        set_section(mcu, 1, low)
        mcu.send("sos_filter_set_active", oid=FILTER, n_sections=2, coeff_frac_bits=BITS)
        chip = Hx711(mcu, values)
        mcu.send("query_hx71x", oid=CELL, rest_ticks=MS // 10)
        home(mcu, 1, threshold)
        mcu.run(0.005 * (len(values) + 1))
        clock = mcu.ask("trigger_analog_query_state", oid=TRIGGER)["homing_clock"]
        assert round(((clock - chip.start) & 0xFFFFFFFF) / PERIOD) - 1 == expected


def test_a_section_beyond_the_filter_is_refused() -> None:
    mcu = cell_board()
    set_section(mcu, 2, (1.0, 0.0, 0.0, 0.0, 0.0))
    assert mcu.shutdown_reason() == "Filter section index larger than max_sections"


def test_an_ldc1612_is_read_when_it_says_that_it_has_a_conversion() -> None:
    mcu = Mcu()
    mcu.configure(
        2,
        ("config_i2c", {"oid": 0}),
        ("i2c_set_bus", {"oid": 0, "i2c_bus": 0, "rate": 400_000, "address": 42}),
        ("config_ldc1612", {"oid": 1, "i2c_oid": 0}),
    )
    waiting = [0x01234567, 0x0FFFFFFF, 0x10000001] + [5] * 10
    reads: list[Any] = []

    def reply(address: int, wrote: bytes, count: int) -> tuple[int, bytes]:
        register = wrote[0]
        reads.append(register)
        if register == 0x18:
            return 0, bytes([0, 8 if waiting and len(reads) % 2 else 0])
        word = waiting[0] >> 16 if register == 0 else waiting.pop(0) & 0xFFFF
        return 0, word.to_bytes(2, "big")

    mcu.i2c_reply = reply
    mcu.send("query_ldc1612", oid=1, rest_ticks=MS)
    mcu.run(0.06)
    data = b"".join(m["data"] for m in mcu.replies("sensor_bulk_data"))
    assert data[:12].hex() == "012345670fffffff10000001"


def test_an_angle_has_the_time_of_its_reading() -> None:
    """An AS5047D: the angle comes a frame later, in 14 bits, with even parity."""
    mcu = Mcu()
    mcu.configure(
        2,
        ("config_spi", {"oid": 0, "pin": 5, "cs_active_high": 0}),
        ("spi_set_bus", {"oid": 0, "spi_bus": 0, "mode": 1, "rate": 1_000_000}),
        ("config_spi_angle", {"oid": 1, "spi_oid": 0, "spi_angle_type": 1}),
    )
    words = iter([0x1234, 0x8001, 0x4000] * 20)
    state = {"frames": 0, "answer": 0}

    def reply(_bus: int, sent: bytes) -> bytes:
        assert sent == b"\xff\xff"
        answer = state["answer"]
        state["frames"] += 1
        if state["frames"] % 2:
            state["answer"] = next(words)
        return answer.to_bytes(2, "big")

    mcu.spi_reply = reply
    mcu.send("query_spi_angle", oid=1, clock=(mcu.now + MS) & 0xFFFFFFFF, rest_ticks=MS, time_shift=4)
    mcu.run(0.022)
    data = b"".join(m["data"] for m in mcu.replies("sensor_bulk_data"))
    rows = [data[at : at + 3] for at in range(0, len(data), 3)]
    assert len(rows) == 17
    angles = [int.from_bytes(row[1:], "little") for row in rows]
    # 0x1234 and 0x8001 have an odd and an even number of ones: the first is a broken frame
    assert [row[0] == 0xFF for row in rows[:3]] == [True, False, True]
    assert angles[1] == 0x0001 << 2


@pytest.mark.parametrize(
    ("kind", "mode", "sent", "good", "angle", "bad"),
    [
        # the answer comes a frame later; bit 15 is an error
        (0, 3, ["3200", "3200"], ["0000", "5678"], 0x5678 << 1, ["0000", "d678"]),
        # the angle in 15 bits, then the safety word: its bit 14 falls with an invalid access
        (2, 1, ["802100000000"], ["0000d678f0aa"], (0x5678 << 1) & 0xFFFF, ["0000d678b0aa"]),
        # two registers: 14 bits, no magnet, parity
        (3, 3, ["830000"], ["001235"], 0x1234, ["001236"]),
        (3, 3, ["830000"], ["001235"], 0x1234, ["001234"]),
        # a burst: 15 bits, status (bit 1: weak field), check sum
        (4, 3, ["a00300000000"], ["0000567901aa"], 0x5678, ["0000567902aa"]),
    ],
)
def test_each_angle_chip_is_read_in_its_own_frames(
    kind: int, mode: int, sent: list[str], good: list[str], angle: int, bad: list[str]
) -> None:
    """types: A1333, TLE5012B, MT6816, MT6826S; the second reading is one that the chip says is none."""
    mcu = Mcu()
    mcu.configure(
        2,
        ("config_spi", {"oid": 0, "pin": 5, "cs_active_high": 0}),
        ("spi_set_bus", {"oid": 0, "spi_bus": 0, "mode": mode, "rate": 1_000_000}),
        ("config_spi_angle", {"oid": 1, "spi_oid": 0, "spi_angle_type": kind}),
    )
    frames: list[str] = []

    def reply(_bus: int, data: bytes) -> bytes:
        frames.append(data.hex())
        number = len(frames) - 1
        source = bad if number // len(sent) % 2 else good
        return bytes.fromhex(source[number % len(sent)])

    mcu.spi_reply = reply
    mcu.send("query_spi_angle", oid=1, clock=(mcu.now + MS) & 0xFFFFFFFF, rest_ticks=MS, time_shift=4)
    mcu.run(0.022)
    assert frames[: 2 * len(sent)] == sent * 2
    data = b"".join(m["data"] for m in mcu.replies("sensor_bulk_data"))
    assert int.from_bytes(data[1:3], "little") == angle and data[0] != 0xFF
    assert data[3] == 0xFF
