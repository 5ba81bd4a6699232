"""The accelerometers that are known: their registers, rates and scales, from their data sheets.

`prepare` and `run` are written in this order, `prepare` before the firmware begins to read, `run` after: so the first
sample of a measurement is the first that the chip takes. A write is (register, value), or (bank, register, value) for
the ICM-20948. Sections of the data sheets are named in klippy/simulation/plant/accel_chip.h.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

GRAVITY_MM_S2 = 9806.65
Write = tuple[int, ...]
Writes = tuple[Write, ...]


@dataclass(frozen=True, slots=True)
class Chip:
    """One kind of accelerometer, as it is used: its widest range, its FIFO in streaming mode."""

    name: str
    command: str  # of config_NAME, query_NAME
    identities: tuple[int, ...]
    identity_register: int
    rates: tuple[int, ...]
    default_rate: int
    mm_s2_per_count: float
    range_g: float
    noise_ug: float  # per sqrt(Hz), typical
    prepare: Callable[[int], Writes]
    run: Writes
    stop: Writes
    buses: tuple[str, ...]  # the default first
    byte_order: str = "little"
    sample_bytes: int = 6
    address: int = 0
    wake: Writes = ()  # before the identity can be read
    spi_wakes_by_reading: bool = False
    message_values: Mapping[str, str] = field(default_factory=dict)
    max_register: int = 0x7F

    @property
    def samples_per_message(self) -> int:
        """Whole samples in the 52 bytes of a sensor_bulk_data message."""
        return 52 // self.sample_bytes


def _adxl345(rate: int) -> Writes:
    # measuring off; full resolution, 16 g; FIFO bypassed, which empties it; rate; FIFO streaming
    rate_code = 8 + (rate // 25).bit_length() - 1
    return (0x2D, 0x00), (0x31, 0x0B), (0x38, 0x00), (0x2C, rate_code), (0x38, 0x80)


def _lis2dw(rate: int) -> Writes:
    # off; FIFO bypassed; address counts up, block update; 16 g, low noise; FIFO continuous
    return (0x20, 0x00), (0x2E, 0x00), (0x21, 0x0C), (0x25, 0x34), (0x2E, 0xC0)


def _lis3dh(rate: int) -> Writes:
    # off; FIFO bypassed; block update, 16 g, high resolution; FIFO on, streaming
    return (0x20, 0x00), (0x2E, 0x00), (0x23, 0xB8), (0x24, 0x40), (0x2E, 0x80)


def _mpu9250(rate: int) -> Writes:
    # awake, accelerometer alone; 16 g; without filter: 4 kHz; nothing into the FIFO; empty it, on
    return (
        (0x6B, 0x01), (0x6C, 0x07), (0x1C, 0x18), (0x1D, 0x08), (0x23, 0x00), (0x6A, 0x04), (0x6A, 0x40),
    )  # fmt: skip


def _icm20948(rate: int) -> Writes:
    # awake, accelerometer alone; 16 g, without filter: 4.5 kHz; nothing into the FIFO; empty it, streaming, on
    return (
        (0, 0x06, 0x01), (0, 0x07, 0x07), (2, 0x14, 0x06), (0, 0x67, 0x00), (0, 0x69, 0x00), (0, 0x68, 0x1F),
        (0, 0x68, 0x00), (0, 0x03, 0x40),
    )  # fmt: skip


def _bmi160(rate: int) -> Writes:
    # accelerometer on; 16 g; 1600 Hz, normal filter; FIFO without headers or sources; empty it
    return (0x7E, 0x11), (0x41, 0x0C), (0x40, 0x2C), (0x47, 0x00), (0x7E, 0xB0)


CHIPS: dict[str, Chip] = {
    chip.name: chip
    for chip in (
        Chip(
            "adxl345", "adxl345", (0xE5,), 0x00, (25, 50, 100, 200, 400, 800, 1600, 3200), 3200,
            GRAVITY_MM_S2 / 256.0, 16.0, 400.0, _adxl345, ((0x2D, 0x08),), ((0x2D, 0x00),), ("spi",), sample_bytes=5,
            max_register=0x3F,
        ),
        Chip(
            "lis2dw", "lis2dw", (0x44,), 0x0F, (1600,), 1600, GRAVITY_MM_S2 * 0.244e-3 * 8 / 4.0, 16.0, 90.0, _lis2dw,
            ((0x20, 0x94),), ((0x20, 0x00),), ("spi", "i2c"), address=0x19, message_values={"lis_chip_type": "LIS2DW"},
            max_register=0x3F,
        ),
        Chip(
            "lis3dh", "lis2dw", (0x33,), 0x0F, (1344,), 1344, GRAVITY_MM_S2 * 12e-3 / 16.0, 16.0, 220.0, _lis3dh,
            ((0x20, 0x97),), ((0x20, 0x00),), ("spi", "i2c"), address=0x19, message_values={"lis_chip_type": "LIS3DH"},
            max_register=0x3F,
        ),
        Chip(
            "mpu9250", "mpu9250", (0x71, 0x73, 0x70, 0x68, 0x74, 0x75), 0x75, (4000,), 4000, GRAVITY_MM_S2 / 2048.0,
            16.0, 300.0, _mpu9250, ((0x23, 0x08),), ((0x23, 0x00), (0x6B, 0x40)), ("i2c",), byte_order="big",
            address=0x68, wake=((0x6B, 0x01),), max_register=0x7E,
        ),
        Chip(
            "icm20948", "icm20948", (0xEA,), 0x00, (4500,), 4500, GRAVITY_MM_S2 / 2048.0, 16.0, 230.0, _icm20948,
            ((0, 0x67, 0x10),), ((0, 0x67, 0x00), (0, 0x06, 0x40)), ("i2c",), byte_order="big", address=0x68,
            wake=((0, 0x06, 0x01),), max_register=0x7E,
        ),
        Chip(
            "bmi160", "bmi160", (0xD1,), 0x00, (1600,), 1600, GRAVITY_MM_S2 / 2048.0, 16.0, 180.0, _bmi160,
            ((0x47, 0x40),), ((0x47, 0x00), (0x7E, 0x10)), ("spi", "i2c"), address=0x69, spi_wakes_by_reading=True,
        ),
    )
}  # fmt: skip
