"""The file of [print_recovery]: two slots of fixed size, written in turn, each with a checksum.

A write that is cut short damages one slot; the other holds the record before. Nothing is synced to the card: a process
that is killed loses nothing that was written, and after a power loss the boards have lost their step counts anyway.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from typing import Any

SLOT_BYTES = 8192
_HEAD = struct.Struct("<III")  # checksum of what follows, number of the record, bytes of text


class Journal:
    """The last record that was written, as JSON values."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.bytes_written = 0
        self._sequence = 0
        self.record: dict[str, Any] = {}

    def read(self) -> dict[str, Any]:
        """The newest whole record; empty if there is none."""
        try:
            with open(self.path, "rb") as file:
                content = file.read(2 * SLOT_BYTES)
        except OSError:
            content = b""
        found = [_decode(content[at : at + SLOT_BYTES]) for at in (0, SLOT_BYTES)]
        self._sequence, self.record = max(found, key=lambda entry: entry[0])
        return self.record

    def write(self, record: dict[str, Any]) -> None:
        """Put a record into the older slot. Raises OSError."""
        text = json.dumps(record, separators=(",", ":")).encode()
        if len(text) > SLOT_BYTES - _HEAD.size:
            raise OSError(f"the record has {len(text)} bytes, more than {SLOT_BYTES - _HEAD.size}")
        self._sequence += 1
        data = _HEAD.pack(0, self._sequence, len(text)) + text
        data = struct.pack("<I", zlib.crc32(data[4:])) + data[4:]
        file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            os.pwrite(file, data, self._sequence % 2 * SLOT_BYTES)
        finally:
            os.close(file)
        self.bytes_written += len(data)
        self.record = record


def _decode(slot: bytes) -> tuple[int, dict[str, Any]]:
    """(sequence, record); (0, {}) for a slot that is empty or damaged."""
    if len(slot) < _HEAD.size:
        return 0, {}
    checksum, sequence, length = _HEAD.unpack_from(slot)
    end = _HEAD.size + length
    if end > len(slot) or checksum != zlib.crc32(slot[4:end]):
        return 0, {}
    return sequence, json.loads(slot[_HEAD.size : end])
