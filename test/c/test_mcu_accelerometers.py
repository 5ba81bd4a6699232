"""Accelerometers on the simulated MCU: each chip is read in its own way, packed, counted; failures are counted too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from mcu_harness import FREQ, Mcu

MS = FREQ // 1000
SPI = [("config_spi", {"oid": 0, "pin": 5, "cs_active_high": 0})]
SPI_BUS = ("spi_set_bus", {"oid": 0, "spi_bus": 0, "mode": 3, "rate": 4_000_000})
I2C = [
    ("config_i2c", {"oid": 0}),
    ("i2c_set_bus", {"oid": 0, "i2c_bus": 0, "rate": 400_000, "address": 0x68}),
]
CHIPS = {"LIS2DW": 0, "LIS3DH": 1}


def board(on_spi: bool, config: str, **options: int) -> Mcu:
    mcu = Mcu()
    bus = [*SPI, SPI_BUS] if on_spi else I2C
    mcu.configure(2, *bus, (config, {"oid": 1, **options}))
    return mcu


class Fifo:
    """Samples in a chip's memory, and the registers it is read by."""

    def __init__(self, count_at: int, data_at: int, count: Callable[[int], bytes], step: int = 6) -> None:
        self.count_at, self.data_at, self.count, self.step = count_at, data_at, count, step
        self.waiting: list[bytes] = []

    def read(self, register: int, length: int) -> bytes:
        if register == self.count_at:
            return self.count(len(self.waiting))[:length]
        assert register == self.data_at and length % 6 == 0
        taken = [self.waiting.pop(0) for _ in range(length // 6)]
        return b"".join(taken)

    def spi(self, _bus: int, sent: bytes) -> bytes:
        return b"\xff" + self.read(sent[0], len(sent) - 1)


def sample(number: int) -> bytes:
    return b"".join((number * 100 + axis).to_bytes(2, "little", signed=True) for axis in range(3))


def unpacked(data: bytes) -> tuple[int, int, int]:
    """x, y, z of the five bytes of an ADXL345, written from the format's description."""
    bits = [data[0] | (data[3] & 0x1F) << 8, data[1] | (data[4] & 0x1F) << 8]
    bits.append(data[2] | (data[3] >> 5) << 8 | (data[4] >> 5 & 3) << 11)
    x, y, z = ((value ^ 0x1000) - 0x1000 for value in bits)
    return x, y, z


def collected(mcu: Mcu, size: int) -> list[bytes]:
    messages = mcu.replies("sensor_bulk_data")
    assert [m["sequence"] for m in messages] == list(range(len(messages)))
    data = b"".join(m["data"] for m in messages)
    return [data[at : at + size] for at in range(0, len(data), size)]


def test_an_adxl345_is_read_sample_by_sample_and_packed_into_five_bytes() -> None:
    mcu = board(True, "config_adxl345", spi_oid=0)
    chip = Fifo(0xB9, 0xF2, lambda n: bytes([n]))
    mcu.spi_reply = chip.spi
    values = [(0, 1, -1), (4095, -4096, 17), (-2048, 2047, -4096)] * 4
    chip.waiting = [b"".join(v.to_bytes(2, "little", signed=True) for v in row) for row in values]
    mcu.send("query_adxl345", oid=1, rest_ticks=MS)
    mcu.run(0.0015)
    assert [unpacked(row) for row in collected(mcu, 5)] == values[
        :10
    ]  # the other two wait for a full message
    status = mcu.ask("query_adxl345_status", oid=1)
    assert (status["buffered"], status["next_sequence"], status["possible_overflows"]) == (10, 1, 0)


WORD_CHIPS = {
    "lis2dw": (True, {"bus_oid": 0, "bus_oid_type": 0, "lis_chip_type": 0}, 0xAF, 0xA8, "one"),
    "lis2dw i2c": (False, {"bus_oid": 0, "bus_oid_type": 1, "lis_chip_type": 0}, 0x2F, 0x28, "one"),
    "lis2dw lis3dh": (True, {"bus_oid": 0, "bus_oid_type": 0, "lis_chip_type": 1}, 0xAF, 0xE8, "one"),
    "lis2dw lis3dh i2c": (False, {"bus_oid": 0, "bus_oid_type": 1, "lis_chip_type": 1}, 0x2F, 0xA8, "one"),
    "mpu9250": (False, {"i2c_oid": 0}, 0x72, 0x74, "big"),
    "icm20948": (False, {"i2c_oid": 0}, 0x70, 0x72, "big"),
    "bmi160": (True, {"bus_oid": 0, "bus_oid_type": 0}, 0xA2, 0xA4, "little"),
    "bmi160 i2c": (False, {"bus_oid": 0, "bus_oid_type": 1}, 0x22, 0x24, "little"),
}


@pytest.mark.parametrize("name", WORD_CHIPS)
def test_the_other_chips_are_read_in_bursts_as_they_send(name: str) -> None:
    on_spi, options, count_at, data_at, order = WORD_CHIPS[name]
    config = name.split(maxsplit=1)[0]
    mcu = board(on_spi, f"config_{config}", **options)
    count: Callable[[int], bytes] = lambda n: bytes([n]) if order == "one" else (6 * n).to_bytes(2, order)  # noqa: E731
    chip = Fifo(count_at, data_at, count)
    if on_spi:
        mcu.spi_reply = chip.spi
    else:
        mcu.i2c_reply = lambda address, wrote, length: (0, chip.read(wrote[0], length))
    sent = [sample(number) for number in range(20)]
    chip.waiting = sent[:3]
    mcu.send(f"query_{config}", oid=1, rest_ticks=MS)
    mcu.run(0.0015)
    assert collected(mcu, 6) == []
    chip.waiting = sent[3:]
    mcu.run(0.001)
    assert collected(mcu, 6) == sent[:16] and chip.waiting == []
    assert mcu.ask(f"query_{config}_status", oid=1)["buffered"] == 24
    mcu.send(f"query_{config}", oid=1, rest_ticks=0)
    chip.waiting = [sample(0)] * 8
    mcu.run(0.01)
    assert len(collected(mcu, 6)) == 16, "a stopped chip is not read"


def test_full_memory_counts_as_an_overflow() -> None:
    mcu = board(True, "config_lis2dw", **WORD_CHIPS["lis2dw"][1])
    chip = Fifo(0xAF, 0xA8, lambda n: bytes([0x40 | min(n, 32)]))
    mcu.spi_reply = chip.spi
    chip.waiting = [sample(n) for n in range(64)]
    mcu.send("query_lis2dw", oid=1, rest_ticks=MS)
    mcu.run(0.0015)
    assert (
        mcu.ask("query_lis2dw_status", oid=1)["possible_overflows"] == 2
    )  # that reading, and the status itself


def test_a_device_that_is_gone_gives_failures_and_no_samples() -> None:
    mcu = board(True, "config_adxl345", spi_oid=0)
    mcu.spi_reply = lambda bus, sent: b"\xff" * len(sent)
    mcu.send("query_adxl345", oid=1, rest_ticks=MS)
    mcu.run(0.0115)
    assert [row[4] >> 7 for row in collected(mcu, 5)] == [1] * 10
    mcu = board(False, "config_mpu9250", i2c_oid=0)
    mcu.i2c_reply = lambda address, wrote, length: (3, bytes(length))
    mcu.send("query_mpu9250", oid=1, rest_ticks=MS)
    mcu.run(0.0055)
    assert collected(mcu, 6) == []
    assert mcu.ask("query_mpu9250_status", oid=1)["possible_overflows"] == 6


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"bus_oid": 0, "bus_oid_type": 2, "lis_chip_type": 0}, "bus_type invalid"),
        ({"bus_oid": 0, "bus_oid_type": 0, "lis_chip_type": 2}, "model type invalid"),
        ({"bus_oid": 0, "bus_oid_type": 1, "lis_chip_type": 0}, "Invalid oid type"),
    ],
)
def test_a_configuration_that_cannot_be_shuts_down(options: dict[str, Any], reason: str) -> None:
    mcu = Mcu()
    mcu.send("allocate_oids", count=2)
    for name, values in [*SPI, SPI_BUS, ("config_lis2dw", {"oid": 1, **options})]:
        mcu.send(name, **values)
    assert mcu.shutdown_reason() == reason
