"""What a screen is drawn on, whatever chip shows it: cells for letters, glyphs of one or two cells, bars.

    screen or menu ─► Panel (what is to be seen) ─► changes() ─► messages to the chip, one a step

A panel remembers what the chip shows and sends differences. `start` and `changes` are generators: they yield after each
message, or the seconds to wait before the next, so that whoever runs them decides how much goes out at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from . import font8x16

Steps = Iterator[float]


@dataclass(frozen=True, slots=True)
class Glyph:
    """`rows`: 16 of 16 pixels; `cell`: 8 of 5 pixels for a character display, kept in its slot 0 to 7."""

    rows: Sequence[int] | None = None
    cell: Sequence[int] | None = None
    slot: int = 0
    letter: str | None = None  # in place of pixels: a letter that all displays have


class Panel(Protocol):
    """A display of `columns` x `rows` cells."""

    columns: int
    rows: int
    mcu: Any

    def start(self) -> Steps:
        """Set the chip up; nothing is known of what it shows."""

    def changes(self) -> Steps:
        """Bring what was put since `erase` to the chip."""

    def erase(self) -> None:
        """Begin an empty picture."""

    def put_text(self, row: int, column: int, text: str) -> None:
        """Letters from a cell on; what does not fit is cut off."""

    def put_glyph(self, row: int, column: int, glyph: Glyph) -> int:
        """A glyph; returns the cells it takes."""

    def put_bar(self, row: int, column: int, width: int, share: float) -> None:
        """A bar of `width` cells, filled up to a share of 0 to 1."""


def put_line(panel: Panel, glyphs: Mapping[str, Glyph], row: int, column: int, text: str) -> None:
    """A text in which ~name~ stands for a glyph. Tildes about anything else are letters."""
    first, *parts = text.split("~")
    panel.put_text(row, column, first)
    column += len(first)
    while parts:
        name = parts.pop(0)
        glyph = glyphs.get(name) if parts else None
        if glyph is None:
            panel.put_text(row, column, f"~{name}")
            column += len(name) + 1
            continue
        column += panel.put_glyph(row, column, glyph)
        after = parts.pop(0)
        panel.put_text(row, column, after)
        column += len(after)


class PixelCanvas:
    """128 x 64 pixels: 64 rows of 16 bytes, the leftmost pixel in bit 7. Cells are 8 x 16 pixels."""

    columns, rows = 16, 4

    def __init__(self) -> None:
        self.pixels = bytearray(1024)

    def erase(self) -> None:
        self.pixels = bytearray(1024)

    def _stamp(self, row: int, column: int, rows: Sequence[int]) -> None:
        """Pixels of one cell; those that meet others turn them dark."""
        if 0 <= row < self.rows and 0 <= column < self.columns:
            place = row * 256 + column
            for bits in rows:
                self.pixels[place] ^= bits
                place += 16

    def put_text(self, row: int, column: int, text: str) -> None:
        for letter in text:
            self._stamp(row, column, font8x16.bitmap(letter))
            column += 1

    def put_glyph(self, row: int, column: int, glyph: Glyph) -> int:
        if glyph.rows is None:
            self.put_text(row, column, glyph.letter or " ")
            return 1
        self._stamp(row, column, [bits >> 8 for bits in glyph.rows])
        self._stamp(row, column + 1, [bits & 0xFF for bits in glyph.rows])
        return 2

    def put_bar(self, row: int, column: int, width: int, share: float) -> None:
        inside = 8 * width - 2  # between the ends of the frame
        filled = round(min(1.0, max(0.0, share)) * inside)
        frame = (1 << 8 * width) - 1
        middle = 1 << 8 * width - 1 | ((1 << filled) - 1) << (inside - filled + 1) | 1
        for cell in range(width):
            shift = 8 * (width - 1 - cell)
            edge, body = frame >> shift & 0xFF, middle >> shift & 0xFF
            self._stamp(row, column + cell, [0, 0, edge, *[body] * 11, edge, 0])


def differences(shown: Sequence[int], wanted: Sequence[int], gap: int) -> Iterator[tuple[int, int]]:
    """Where they differ: (start, end), those with up to `gap` equal places between them as one."""
    start = end = -1
    for place, (old, new) in enumerate(zip(shown, wanted, strict=True)):
        if old == new:
            continue
        if start >= 0 and place - end > gap:
            yield start, end
            start = -1
        if start < 0:
            start = place
        end = place + 1
    if start >= 0:
        yield start, end
