"""Display chips from their data sheets: commands and data in, pixels out.

    St7920     DDRAM of letters and GDRAM of pixels, overlaid; basic and extended commands
    Hd44780    80 letters, eight loadable glyphs; an interface of eight or four lines
    PageChip   UC1701x, SSD1306, SH1106: pages of eight lines

A picture is a list of rows, each a list of 0 and 1. What a data sheet does not define raises ChipError.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from extras.display import font8x16

from . import font5x8

Picture = list[list[int]]


class ChipError(Exception):
    """The chip has been sent what its data sheet does not allow."""


class St7920:
    """Letters of its generator look as in our own font: the shapes in the chip's ROM are not ours to copy."""

    TEXT_ROWS = (0x00, 0x10, 0x08, 0x18)

    def __init__(self) -> None:
        self.letters = bytearray(b"\xff" * 64)  # by DDRAM address, two each; undefined after power-on
        self.pixels = bytearray(b"\xaa" * 1024)  # 64 rows of 16 bytes
        self.is_on = self.is_extended = self.shows_pixels = False
        self._line: int | None = None  # of GDRAM; None: the column comes next
        self._place: tuple[str, int] | None = None  # where data goes
        self._sync: int | None = None
        self._upper: int | None = None

    # --- the serial interface ---
    def select(self) -> None:
        """CS rises: the transfer counter starts anew."""
        self._sync = self._upper = None

    def serial_byte(self, value: int) -> None:
        """Eight bits of the serial interface."""
        if value >> 3 == 0x1F:
            if value & 0x05:
                raise ChipError(f"sync byte {value:#x}: nothing can be read")
            self._sync, self._upper = value, None
            return
        if value & 0x0F or self._sync is None:
            raise ChipError(f"{value:#x} is no half of a byte after a sync byte")
        if self._upper is None:
            self._upper = value
            return
        byte, self._upper = self._upper | value >> 4, None
        (self.data if self._sync & 0x02 else self.command)(byte)

    # --- commands ---
    def command(self, value: int) -> None:
        if value & 0x80:
            self._address(value & 0x7F)
        elif value & 0xE0 == 0x20:
            if not value & 0x10:
                raise ChipError("the serial interface needs DL = 1")
            was_extended, self.is_extended = self.is_extended, bool(value & 0x04)
            if was_extended and self.is_extended:  # the two bits cannot change at once
                self.shows_pixels = bool(value & 0x02)
        elif self.is_extended:
            raise ChipError(f"extended command {value:#x} is not modelled")
        elif value == 0x01:
            self.letters = bytearray(b" " * 64)
            self._place = ("letters", 0)
        elif value & 0xF8 == 0x08:
            self.is_on = bool(value & 0x04)
        elif value != 0x06:
            raise ChipError(f"command {value:#x} is not modelled")

    def _address(self, address: int) -> None:
        if not self.is_extended:
            if address & 0x60:
                raise ChipError(f"DDRAM has no address {address:#x}")
            self._place = ("letters", 2 * address)
        elif self._line is None:
            if address > 63:
                raise ChipError(f"GDRAM has no line {address}")
            self._line = address
        else:
            self._place, self._line = ("pixels", 32 * (self._line & 0x1F) + 2 * (address & 0x0F)), None

    def data(self, value: int) -> None:
        if self._place is None:
            raise ChipError("data without an address")
        memory, place = self._place
        if memory == "letters":
            self.letters[place & 0x3F] = value
            self._place = (memory, place + 1)
        else:
            line, column = divmod(place, 32)
            self.pixels[(line + 32 * (column // 16)) * 16 + column % 16] = value
            self._place = (memory, line * 32 + (column + 1) % 32)

    def picture(self) -> Picture:
        rows = [[0] * 128 for _ in range(64)]
        if not self.is_on:
            return rows
        for line, address in enumerate(self.TEXT_ROWS):
            for column in range(16):
                _stamp(
                    rows, 8 * column, 16 * line, 8, font8x16.bitmap(chr(self.letters[2 * address + column]))
                )
        if self.shows_pixels:
            for y, row in enumerate(rows):
                for x in range(128):
                    row[x] |= self.pixels[y * 16 + x // 8] >> 7 - x % 8 & 1
        return rows


def _stamp(rows: Picture, left: int, top: int, width: int, bits: bytes | bytearray | list[int]) -> None:
    for y, value in enumerate(bits):
        for x in range(width):
            rows[top + y][left + x] = value >> 7 - x & 1


# Of the generator's letters beyond ASCII: arrow, degree sign, full block
_ROM_SHAPES = {
    0x7E: [0x00, 0x20, 0x10, 0xF8, 0x10, 0x20, 0x00, 0x00],
    0xDF: [0x60, 0x90, 0x90, 0x60, 0x00, 0x00, 0x00, 0x00],
    0xFF: [0xF8] * 8,
}


class Hd44780:
    """Lines of `columns` letters, the third and fourth after the first two in memory."""

    def __init__(self, columns: int = 20, has_four_lines_interface: bool = True) -> None:
        self.columns = columns
        self.letters = bytearray(b"\xff" * 128)  # by DDRAM address
        self.glyphs = bytearray(b"\x15" * 64)
        self.is_on = False
        self.can_use_four_lines = has_four_lines_interface
        self.uses_four_lines = False
        self._upper: int | None = None
        self._address: tuple[str, int] | None = None

    def strobe(self, lines: int, is_data: bool) -> None:
        """E falls with this on D7 to D4."""
        if not self.uses_four_lines:
            self.byte(lines << 4, is_data)
        elif self._upper is None:
            self._upper = lines
        else:
            upper, self._upper = self._upper, None
            self.byte(upper << 4 | lines, is_data)

    def byte(self, value: int, is_data: bool) -> None:
        if is_data:
            self._data(value)
        elif value & 0x80:
            if value & 0x7F not in range(0x28) and value & 0x7F not in range(0x40, 0x68):
                raise ChipError(f"DDRAM has no address {value & 0x7F:#x}")
            self._address = ("letters", value & 0x7F)
        elif value & 0x40:
            self._address = ("glyphs", value & 0x3F)
        elif value & 0x20:
            self.uses_four_lines = self.can_use_four_lines and not value & 0x10
            self._upper = None
        elif value & 0x08:
            self.is_on = bool(value & 0x04)
        elif value == 0x01:
            self.letters = bytearray(b" " * 128)
            self._address = ("letters", 0)
        elif value not in (0x00, 0x06):
            raise ChipError(f"command {value:#x} is not modelled")

    def _data(self, value: int) -> None:
        if self._address is None:
            raise ChipError("data without an address")
        memory, place = self._address
        if memory == "letters":
            self.letters[place] = value
            following = {0x27: 0x40, 0x67: 0x00}.get(place, place + 1)
        else:
            self.glyphs[place] = value & 0x1F
            following = place + 1 & 0x3F
        self._address = (memory, following)

    def line(self, number: int) -> bytes:
        """The codes on a line."""
        first = (0x00, 0x40, self.columns, 0x40 + self.columns)[number]
        return bytes(self.letters[first : first + self.columns])

    def text(self) -> list[str]:
        """The lines, glyphs as the numbers of their slots."""
        return ["".join(chr(code) if code > 7 else str(code) for code in self.line(n)) for n in range(4)]

    def picture(self) -> Picture:
        rows = [[0] * (6 * self.columns - 1) for _ in range(4 * 9 - 1)]
        if self.is_on:
            for number in range(4):
                for column, code in enumerate(self.line(number)):
                    _stamp(rows, 6 * column, 9 * number, 5, self._shape(code))
        return rows

    def _shape(self, code: int) -> bytes | list[int]:
        if code < 0x10:
            return [row << 3 for row in self.glyphs[(code & 7) * 8 : (code & 7) * 8 + 8]]
        return _ROM_SHAPES.get(code) or font5x8.bitmap(chr(code))


@dataclass(frozen=True, slots=True)
class PageKind:
    """What differs: columns of memory; commands with an argument of one byte; those without."""

    columns: int
    with_argument: frozenset[int]
    plain: frozenset[int]
    power_on: frozenset[tuple[int, ...]]  # commands without which the glass stays dark
    mirrors: bool  # columns are wired from the right


_OLED_ARGUMENTS = {0xD5, 0xA8, 0xD3, 0xDA, 0x81, 0xD9, 0xDB}
_SHARED = {0xA0, 0xA1, 0xC0, 0xC8, 0xA4, 0xA5, 0xA6, 0xA7, 0xAE, 0xAF, *range(0x40, 0x80)}
PAGE_KINDS: Mapping[str, PageKind] = {
    "uc1701": PageKind(
        132,
        frozenset({0x81, 0xF8, 0xAC, 0xFA}),
        frozenset({*_SHARED, 0xE2, 0xA2, 0xA3, *range(0x20, 0x30)}),
        frozenset({(0x2F,)}),
        False,
    ),
    "ssd1306": PageKind(
        128,
        frozenset({*_OLED_ARGUMENTS, 0x8D, 0x20}),
        frozenset({*_SHARED, 0x2E}),
        frozenset({(0x8D, 0x14), (0x20, 0x02)}),
        True,
    ),
    "sh1106": PageKind(
        132, frozenset({*_OLED_ARGUMENTS, 0xAD}), frozenset(_SHARED), frozenset({(0xAD, 0x8B)}), True
    ),
}


class PageChip:
    """`first_column`: of memory, that the glass begins with."""

    def __init__(self, kind: str, first_column: int = 0) -> None:
        self.kind = PAGE_KINDS[kind]
        self.first_column = first_column
        self.memory = [bytearray(b"\xaa" * self.kind.columns) for _ in range(8)]
        self.settings: dict[int, int] = {}
        self._done: set[tuple[int, ...]] = set()
        self._page = self._column = 0
        self._waiting: int | None = None  # a command whose argument comes next

    def reset(self) -> None:
        """The reset line is low: settings are lost, memory is kept."""
        self.settings, self._waiting = {}, None
        self._done = set()

    @property
    def is_on(self) -> bool:
        return 0xAF in self.settings and self.kind.power_on <= self._done

    def command(self, value: int) -> None:
        if self._waiting is not None:
            self.settings[self._waiting] = value
            self._done.add((self._waiting, value))
            self._waiting = None
        elif value in self.kind.with_argument:
            self._waiting = value
        elif value & 0xF8 == 0xB0:
            self._page = value & 7
        elif value & 0xF0 == 0x10:
            self._column = self._column & 0x0F | value << 4 & 0xF0
        elif value & 0xF0 == 0x00:
            self._column = self._column & 0xF0 | value
        elif value in self.kind.plain:
            self._plain(value)
        else:
            raise ChipError(f"command {value:#x} is not in the data sheet")

    def _plain(self, value: int) -> None:
        for pair in ((0xAE, 0xAF), (0xA6, 0xA7)):
            if value in pair:
                for other in pair:
                    self.settings.pop(other, None)
        self.settings[value] = 0
        self._done.add((value,))

    def data(self, value: int) -> None:
        if self._waiting is not None:
            raise ChipError(f"data in place of the argument of command {self._waiting:#x}")
        if self._column >= self.kind.columns:
            raise ChipError(f"there is no column {self._column}")
        self.memory[self._page][self._column] = value
        self._column += 1

    def picture(self) -> Picture:
        dark = int(0xA7 in self.settings)
        rows = [[0] * 128 for _ in range(64)]
        if self.is_on:
            for y in range(64):
                for x in range(128):
                    rows[y][x] = (self.memory[y // 8][self.first_column + x] >> y % 8 & 1) ^ dark
        return rows
