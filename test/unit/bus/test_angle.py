"""Angle sensors: registers of the chips, the stream's times and turns, the table of their error."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from bus_rig import FREQ, BusSession, run, start_error
from extras.angles.chips import tle5012b_celsius
from extras.angles.table import TURN, corrected, make_table

ANGLE = "[angle a]\nsensor_type: {}\ncs_pin: PA1\n"


class As5047d:
    """Frames of 16 bits with even parity; the answer comes with the next frame (AS5047D v1-12, SPI)."""

    def __init__(self) -> None:
        self.registers = {0x3FFD: 0x0180, 0x0016: 0x0011}
        self.answer = 0
        self.writing: int | None = None

    def transfer(self, values: list[Any]) -> dict[str, Any]:
        word = int.from_bytes(bytes(values[1]), "big")
        assert word.bit_count() % 2 == 0, "parity"
        answer, self.answer = self.answer, 0
        if self.writing is not None:
            self.registers[self.writing] = word & 0x3FFF
            self.writing = None
        elif word & 0x4000:
            self.answer = self.registers.get(word & 0x3FFF, 0)
        else:
            self.writing = word & 0x3FFF
        return {"clock": 0, "response": answer.to_bytes(2, "big")}


class Tle5012b:
    """Command, data word, safety word (TLE5012B V2.1, SSC)."""

    def __init__(self) -> None:
        self.registers = {0x02: 0x8123, 0x05: 0}

    def transfer(self, values: list[Any]) -> dict[str, Any]:
        data = bytes(values[1])
        command = int.from_bytes(data[:2], "big")
        register = command >> 4 & 0x3F
        if command >> 15:
            return {
                "clock": 0,
                "response": data[:2] + self.registers.get(register, 0).to_bytes(2, "big") + b"\xf0\x00",
            }
        assert register < 5 or command >> 11 & 0xF == 0b1010, "locked"
        self.registers[register] = int.from_bytes(data[2:4], "big")
        return {"clock": 0, "response": data}


@pytest.mark.parametrize(
    ("kind", "chip", "register", "expected"),
    [("as5047d", As5047d(), 0x3FFD, "0x0180"), ("tle5012b", Tle5012b(), 0x02, "0x8123")],
)
def test_registers_are_read_and_written(
    tmp_path: Path, kind: str, chip: Any, register: int, expected: str
) -> None:
    def body(s: BusSession) -> None:
        s.chip.answers["spi_angle_transfer"] = chip.transfer
        s.gcode.run_script(f"ANGLE_DEBUG_READ CHIP=a REG={register:#x}")
        assert s.lines[-1].endswith(expected)
        s.gcode.run_script("ANGLE_DEBUG_WRITE CHIP=a REG=0x06 VAL=0x155")
        assert chip.registers[6] == 0x155
        s.gcode.run_script("ANGLE_CHIP_CALIBRATE CHIP=a")
        assert "no calibration" in s.lines[-1]

    run(tmp_path, ANGLE.format(kind), body)


def test_samples_have_the_times_at_which_they_were_read(tmp_path: Path) -> None:
    """Due every 0.4 ms from the first clock on, later by their own time; turns add up; failures are counted."""

    def body(s: BusSession) -> None:
        angle = s.printer.lookup_object("angle a")
        batches: list[dict[str, Any]] = []
        angle._batches.add_client(lambda batch: batches.append(batch) or True)
        ((_, first, rest, shift),) = s.chip.messages("query_spi_angle")
        assert rest == round(0.0004 * FREQ) and rest << 2 < 254 << shift
        rows = [(5, 65000), (0, 65500), (0xFF, 0), (1, 400), (2, 900)] + [(0, 1000)] * 12
        data = b"".join(bytes([late]) + value.to_bytes(2, "little") for late, value in rows)
        for sequence in (0, 2):  # one message is lost
            s.chip.report("sensor_bulk_data", angle.oid, sequence=sequence, data=data)
        s.sleep(0.3)
        found = [row for batch in batches for row in batch["data"]]
        assert sum(batch["errors"] for batch in batches) == 2
        assert [a for _, a in found[:4]] == [65000, 65500, TURN + 400, TURN + 900]
        assert found[0][0] == pytest.approx((first + (5 << shift)) / FREQ, abs=1e-6)
        assert found[2][0] == pytest.approx((first + 3 * rest + (1 << shift)) / FREQ, abs=1e-6)
        assert found[16][0] == pytest.approx((first + 34 * rest + (5 << shift)) / FREQ, abs=1e-6)

    run(tmp_path, ANGLE.format("a1333"), body)


def test_a_tle5012b_reports_its_temperature(tmp_path: Path) -> None:
    """Data sheet: T = (code + 152) / 2.776."""
    assert tle5012b_celsius(0x00 << 7) == pytest.approx(54.8, abs=0.1)
    assert tle5012b_celsius((-83 & 0x1FF) << 7) == pytest.approx(24.9, abs=0.1)
    run(tmp_path, ANGLE.format("tle5012b"), lambda s: None)


def test_a_table_takes_out_the_error_of_a_turn() -> None:
    """A magnet off the axis: once and twice a turn."""
    true = [TURN * n / 200 for n in range(200)]

    def seen(angle: float) -> float:
        turn = 2 * math.pi * angle / TURN
        return angle + 7000.0 + 300.0 * math.sin(turn) + 100.0 * math.cos(2 * turn)

    table = make_table(true, [seen(angle) for angle in true])
    left = [corrected(seen(a) % TURN, table) - (a + 7000.0) % TURN for a in true]
    left = [(d + TURN / 2) % TURN - TURN / 2 for d in left]
    middle = sum(left) / len(left)
    assert max(abs(d - middle) for d in left) < 10.0  # of 300


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (ANGLE.format("as5600"), ("sensor_type", "angle a", "line 2", "tle5012b")),
        (ANGLE.format("a1333") + "sample_period: 0\n", ("sample_period", "line 4")),
        (ANGLE.format("a1333") + "calibrate: 1, 2\n", ("calibrate", "line 4", "64")),
    ],
)
def test_bad_values_are_named_with_their_place(tmp_path: Path, config: str, words: tuple[str, ...]) -> None:
    reason = start_error(tmp_path, config)
    assert all(word in reason for word in words), reason
