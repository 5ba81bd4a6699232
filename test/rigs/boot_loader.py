"""The boot loader of an Arduino Mega on a pseudo terminal, as far as avrdude needs one: STK500 version 2 (AVR068).

0x1b  sequence  length (2, big endian)  0x0e  body  exclusive or of all before
"""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Callable
from pathlib import Path

START, TOKEN, OK, FAILED = 0x1B, 0x0E, 0x00, 0xC0
SIGNATURE = (0x1E, 0x98, 0x01)  # ATmega2560
FLASH_SIZE = 256 * 1024


class BootLoader:
    """Serves until closed. `flash` is what has been written; `breaks` makes the first page come out wrong."""

    def __init__(self, breaks: bool = False) -> None:
        self.flash = bytearray(b"\xff" * FLASH_SIZE)
        self.commands: set[int] = set()
        self.breaks = breaks
        self._address = 0  # bytes
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = Path(os.ttyname(self._slave))
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        os.write(self._slave, b"\x00")  # wakes the reader, who finds its terminal gone
        self._thread.join(5.0)
        os.close(self._slave)
        os.close(self._master)

    def _take(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            data += os.read(self._master, count - len(data))
        return data

    def _serve(self) -> None:
        while (first := self._take(1)[0]) != 0:
            if first != START:
                continue
            sequence, high, low, _token = self._take(4)
            body = self._take(high << 8 | low)
            self._take(1)  # a pseudo terminal damages nothing
            reply = self._answer(body)
            message = bytes([START, sequence, len(reply) >> 8, len(reply) & 0xFF, TOKEN]) + reply
            check = 0
            for byte in message:
                check ^= byte
            os.write(self._master, message + bytes([check]))

    def _answer(self, body: bytes) -> bytes:
        answers: dict[int, Callable[[bytes], bytes]] = {
            0x01: lambda _: bytes([OK, 8]) + b"STK500_2",
            0x03: lambda _: bytes([OK, 2]),
            0x06: self._load_address,
            0x13: self._program_flash,
            0x14: self._read_flash,
            0x1B: lambda body: bytes([OK, SIGNATURE[body[4]], OK]),
            0x1D: self._spi_multi,
        }
        self.commands.add(body[0])
        plain = {0x02, 0x10, 0x11}  # set parameter, enter and leave programming
        if body[0] in plain:
            return bytes([body[0], OK])
        if body[0] not in answers:
            return bytes([body[0], FAILED])
        return body[:1] + answers[body[0]](body)

    def _load_address(self, body: bytes) -> bytes:
        self._address = 2 * (int.from_bytes(body[1:5], "big") & 0x7FFFFFFF)
        return bytes([OK])

    def _program_flash(self, body: bytes) -> bytes:
        count = body[1] << 8 | body[2]
        data = bytearray(body[10 : 10 + count])
        if self.breaks and self._address == 0:
            data[5] ^= 1
        self.flash[self._address : self._address + count] = data
        self._address += count
        return bytes([OK])

    def _read_flash(self, body: bytes) -> bytes:
        count = body[1] << 8 | body[2]
        data = bytes(self.flash[self._address : self._address + count])
        self._address += count
        return bytes([OK]) + data + bytes([OK])

    def _spi_multi(self, body: bytes) -> bytes:
        """An ISP instruction; what a boot loader knows: reading the signature."""
        count = body[2]
        value = SIGNATURE[body[6]] if body[4] == 0x30 else 0xFF
        return bytes([OK]) + bytes(count - 1) + bytes([value, OK])
