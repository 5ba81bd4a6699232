"""A display's picture as a PNG file: grey levels, one bit a pixel, each dot of the display several pixels wide."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from .chips import Picture


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(picture: Picture, scale: int = 4, margin: int = 4) -> bytes:
    """Lit dots are bright, with a dark line between dots."""
    width, height = len(picture[0]) + 2 * margin, len(picture) + 2 * margin
    lines = bytearray()
    for y in range(height):
        dots = picture[y - margin] if margin <= y < height - margin else []
        levels = bytearray()
        for x in range(width):
            lit = bool(dots) and margin <= x < width - margin and dots[x - margin]
            levels += bytes([235 if lit else 30] * (scale - 1) + [30])
        lines += (b"\0" + levels) * (scale - 1) + b"\0" + bytes([30]) * (width * scale)
    header = struct.pack(">IIBBBBB", width * scale, height * scale, 8, 0, 0, 0, 0)
    parts = (_chunk(b"IHDR", header), _chunk(b"IDAT", zlib.compress(bytes(lines), 9)), _chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def save_png(path: Path, picture: Picture) -> None:
    """Raises OSError."""
    path.write_bytes(png(picture))


def as_text(picture: Picture) -> str:
    """The picture as lines of dots, for messages of tests."""
    return "\n".join("".join(".#"[dot] for dot in row) for row in picture)
