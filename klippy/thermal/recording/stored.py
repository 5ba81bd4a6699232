"""The file of a recorded run: frames, compressed. Format 1.

    "FERRITE-RUN 1\\n", then a zlib stream of frames: u8 kind, u32 length, payload; little endian.

| kind | payload |
|---|---|
| `H` header | JSON: format, version, heater, parameters, guard (rows, adc_max), unit; the first frame |
| `S` state | JSON: memory of the loop from here on |
| `b` blocks | f64 now, then 64 bytes a block: i64 sequence, clock; f64 time_s, duration_s, mean_raw; |
| | i32 count, min, max, phase, discarded, lost |
| `t` timer, `r` resume, `s` start | f64 now |
| `f` the filter forgets | |
| `g` target | f64 now, f64 degC |
| `R` reference | f64 now, then f64 times, f64 temperatures; none: it ends |
| `F` flow, `A` fan | f64 before, then f64 times, f64 values |
| `Q` quiet | u8 |
| `P` parameters, `U` parameters taken over by use() | JSON |
| `E` end of what can be decided again, until the next state | text |
| `o` answer to the input before | f64 time, temperature, sigma of the estimate, request in W; |
| | then f64 time, u16 phase for each command |
| `X` fault | text |

Times are print times in seconds. A file that breaks off (a power cut) is read up to its last whole frame.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

MAGIC = b"FERRITE-RUN 1\n"
_HEAD = struct.Struct("<cI")
LENGTH_MAX = 1 << 24
_READ = 1 << 16


class RunFileError(ValueError):
    """Not a recorded run, or one of another format; the text is for people."""


class Frame(NamedTuple):
    kind: str
    payload: bytes

    def json(self) -> Any:
        return json.loads(self.payload)

    def doubles(self) -> tuple[float, ...]:
        return struct.unpack(f"<{len(self.payload) // 8}d", self.payload)


def packed(kind: str, payload: bytes) -> bytes:
    """A frame as it lies in the file."""
    return _HEAD.pack(kind.encode(), len(payload)) + payload


def json_frame(kind: str, value: Any) -> bytes:
    return packed(kind, json.dumps(value, separators=(",", ":")).encode())


class Writer:
    """Frames into an open binary file."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._packer = stream, zlib.compressobj(6)
        stream.write(MAGIC)

    def write(self, frames: bytes) -> None:
        """Raises OSError."""
        self._stream.write(self._packer.compress(frames))

    def close(self) -> None:
        """Raises OSError."""
        with self._stream:
            self._stream.write(self._packer.flush())


def _unpacked(path: Path) -> Iterator[bytes]:
    with path.open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            raise RunFileError(
                f"{path} is no recorded run of format 1 (it does not begin with 'FERRITE-RUN 1')"
            )
        unpacker = zlib.decompressobj()
        while data := stream.read(_READ):
            try:
                yield unpacker.decompress(data)
            except zlib.error:
                raise RunFileError(f"{path} is damaged") from None
        yield unpacker.flush()


def read(path: Path) -> Iterator[Frame]:
    """The frames of a file, in order. Raises RunFileError, OSError."""
    held = b""
    for data in _unpacked(path):
        held, at = held + data, 0
        while len(held) - at >= _HEAD.size:
            kind, length = _HEAD.unpack_from(held, at)
            if length > LENGTH_MAX:
                raise RunFileError(f"{path} is damaged: a frame of {length} bytes")
            end = at + _HEAD.size + length
            if end > len(held):
                break
            yield Frame(kind.decode("latin-1"), held[at + _HEAD.size : end])
            at = end
        held = held[at:]
