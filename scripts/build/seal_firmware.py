#!/usr/bin/env python3
"""Put length and checksum of a linked STM32F334 image into its section .seal (src/stm32f334/seal.c).

Usage: seal_firmware.py ferrite.elf

The checksum covers all that lies in flash before the section: vectors, code, constants, the image of .data. It is
the one the chip's CRC unit computes: polynomial 0x04c11db7, start 0xffffffff, a little-endian word at a time, highest
bit first, nothing reversed.
"""

from __future__ import annotations

import struct
import sys
from dataclasses import dataclass
from pathlib import Path

FLASH_START = 0x08000000
MAGIC = 0x46525354
POLYNOMIAL = 0x04C11DB7
PT_LOAD = 1


@dataclass(frozen=True, slots=True)
class Segment:
    """One loadable part of an ELF file."""

    address: int  # where it is loaded (physical)
    offset: int  # in the file
    size: int  # in the file


def crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ (POLYNOMIAL if crc >> 31 else 0)) & 0xFFFFFFFF
        table.append(crc)
    return table


def crc_of_words(data: bytes) -> int:
    """What the CRC unit makes of `data`, a multiple of four bytes."""
    table, crc = crc_table(), 0xFFFFFFFF
    for (word,) in struct.iter_unpack("<I", data):
        for byte in word.to_bytes(4, "big"):
            crc = (crc << 8 & 0xFFFFFFFF) ^ table[crc >> 24 ^ byte]
    return crc


def load_segments(elf: bytes) -> list[Segment]:
    """The loadable segments of a 32-bit little-endian ELF file."""
    if elf[:6] != b"\x7fELF\x01\x01":
        raise ValueError("this is no 32-bit little-endian ELF file")
    start, size, count = (*struct.unpack_from("<I", elf, 28), *struct.unpack_from("<HH", elf, 42))
    segments = []
    for number in range(count):
        kind, offset, _, address, file_size = struct.unpack_from("<5I", elf, start + number * size)
        if kind == PT_LOAD and file_size:
            segments.append(Segment(address, offset, file_size))
    return sorted(segments, key=lambda segment: segment.address)


def flash_image(elf: bytes) -> bytes:
    """Flash from its beginning to the end of what the file loads there, gaps as erased (0xff)."""
    image = bytearray()
    for segment in load_segments(elf):
        place = segment.address - FLASH_START
        if place < len(image):
            raise ValueError(f"segments overlap at {segment.address:#x}")
        image += b"\xff" * (place - len(image)) + elf[segment.offset : segment.offset + segment.size]
    return bytes(image)


def sealed(elf: bytes) -> bytes:
    """The file with its seal filled in."""
    image = flash_image(elf)
    mark = struct.pack("<3I", MAGIC, 0, 0)
    place = len(image) - len(mark)
    if image[place:] != mark or elf.count(mark) != 1:
        raise ValueError("the image does not end with an empty seal")
    seal = struct.pack("<3I", MAGIC, place // 4, crc_of_words(image[:place]))
    return elf.replace(mark, seal)


def main(argv: list[str]) -> int:
    if len(argv) != 1:
        print((__doc__ or "").strip(), file=sys.stderr)
        return 2
    path = Path(argv[0])
    try:
        path.write_bytes(sealed(path.read_bytes()))
    except (OSError, ValueError) as error:
        print(f"seal_firmware: {path}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
