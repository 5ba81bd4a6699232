"""Registers of the angle sensors over SPI, from the data sheets named in src/angle.c."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

Transfer = Callable[[list[int]], bytes]


@dataclass(frozen=True, slots=True)
class Kind:
    """A chip: SPI mode, largest register, and how a register is read and written (None: it cannot be)."""

    mode: int
    max_register: int
    read: Callable[[Transfer, int], int] | None
    write: Callable[[Transfer, int, int], None] | None


def _even(word: int) -> int:
    """With the parity bit of an AS5047D."""
    return word | (word.bit_count() & 1) << 15


def _words(*words: int) -> list[int]:
    return [byte for word in words for byte in word.to_bytes(2, "big")]


def _read_a1333(transfer: Transfer, register: int) -> int:
    """The answer comes a frame later."""
    transfer(_words(register << 8))
    return int.from_bytes(transfer(_words(0)), "big")


def _write_a1333(transfer: Transfer, register: int, value: int) -> None:
    """A byte at each address."""
    transfer([0x40 | register, value & 0xFF])


def _read_as5047d(transfer: Transfer, register: int) -> int:
    transfer(_words(_even(0x4000 | register)))
    return int.from_bytes(transfer(_words(_even(0x4000))), "big") & 0x3FFF


def _write_as5047d(transfer: Transfer, register: int, value: int) -> None:
    transfer(_words(_even(register)))
    transfer(_words(_even(value & 0x3FFF)))


def _read_tle5012b(transfer: Transfer, register: int) -> int:
    """Command 1 LLLL U AAAAAA NNNN: read one word and the safety word."""
    return int.from_bytes(transfer([*_words(0x8001 | register << 4), 0, 0, 0, 0])[2:4], "big")


def _write_tle5012b(transfer: Transfer, register: int, value: int) -> None:
    """The lock value 1010 opens the registers from 5 on."""
    transfer([*_words(0x5001 | register << 4), *_words(value & 0xFFFF), 0, 0])


def _read_mt6816(transfer: Transfer, register: int) -> int:
    return transfer([0x80 | register, 0])[1]


KINDS = {
    "a1333": Kind(3, 0x3F, _read_a1333, _write_a1333),
    "as5047d": Kind(1, 0x3FFF, _read_as5047d, _write_as5047d),
    "tle5012b": Kind(1, 0x3F, _read_tle5012b, _write_tle5012b),
    "mt6816": Kind(3, 0x7F, _read_mt6816, None),
    "mt6826s": Kind(3, 0, None, None),
}
FRAME_SYNC = 5  # TLE5012B: bits 15..9 temperature, of 2.776 a kelvin and 152 at 0 degC
TEMPERATURE_ZERO, TEMPERATURE_PER_K = 152.0, 2.776


def tle5012b_celsius(word: int) -> float:
    """Of register FSYNC: nine bits with sign."""
    bits = word >> 7 & 0x1FF
    return ((bits ^ 0x100) - 0x100 + TEMPERATURE_ZERO) / TEMPERATURE_PER_K
