"""Character displays of the HD44780's kind: 4 lines of 20 or 16 letters, eight glyphs that can be loaded.

    hd44780       four data lines, made by the firmware (src/lcd_hd44780.c)
    hd44780_spi   the same lines behind a shift register (74HC595) on SPI, as on MightyBoards
    aip31068_spi  the same commands in words of nine bits: RS, then D7 to D0

Data sheet of the HD44780U: figure 24 (four-bit start), table 6 (commands, 37 us at 270 kHz; clear 1.52 ms).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from configfile import ConfigWrapper

from .. import bus
from .panel import Glyph, Steps, differences
from .pins import lookup_pins

CLEAR, RIGHTWARDS, DISPLAY_ON, FOUR_BITS_TWO_LINES, EIGHT_BITS_TWO_LINES = 0x01, 0x06, 0x0C, 0x28, 0x38
SLOT_ADDRESS, LETTER_ADDRESS = 0x40, 0x80
TO_EIGHT_BITS, TO_FOUR_BITS = 0x33, 0x32  # each half is a command by itself
DELAY_S = 53e-6  # 37 us at the slowest oscillator, 190 kHz
START_S, STEP_S = 0.1, 0.01
MESSAGE_BYTES = 12  # the firmware is busy for 1.3 ms with so many
WORDS = 8  # of nine bits in nine bytes

DEGREE, FULL_BLOCK, RIGHT_ARROW, EMPTY_BLOCK = 0xDF, 0xFF, 0x7E, ord("-")
_LETTERS = {"°": DEGREE, "→": RIGHT_ARROW, "µ": 0xE4, "ä": 0xE1, "ö": 0xEF, "ü": 0xF5, "ß": 0xE2, "ñ": 0xEE}


class Transport(Protocol):
    """Brings bytes to the chip. `start`: commands of how wide its interface is, with the wait after each."""

    mcu: Any
    start: list[tuple[int, float]]

    def send(self, data: Sequence[int], is_data: bool) -> None: ...


def _four_bits(config: ConfigWrapper) -> list[tuple[int, float]]:
    """The start on four lines; a chip that is there already must not get the first part."""
    begin = [(TO_EIGHT_BITS, STEP_S), (TO_EIGHT_BITS, STEP_S), (TO_FOUR_BITS, STEP_S)]
    return [
        *(begin if config.getboolean("hd44780_protocol_init", True) else []),
        (FOUR_BITS_TWO_LINES, 0.0),
    ]


class FirmwareTransport:
    """lcd_type hd44780."""

    OPTIONS = ("rs_pin", "e_pin", "d4_pin", "d5_pin", "d6_pin", "d7_pin")

    def __init__(self, config: ConfigWrapper) -> None:
        self.start = _four_bits(config)
        self.mcu, self._pins = lookup_pins(config, self.OPTIONS)
        self._oid = self.mcu.create_oid()
        self._commands: Any = None
        self._data: Any = None
        self.mcu.register_config_callback(self._build_config)

    def _build_config(self) -> None:
        mcu = self.mcu
        rs, e, d4, d5, d6, d7 = self._pins
        mcu.add_config_cmd(
            f"config_hd44780 oid={self._oid} rs_pin={rs} e_pin={e} d4_pin={d4} d5_pin={d5} d6_pin={d6} d7_pin={d7}"
            f" delay_ticks={mcu.seconds_to_clock(DELAY_S)}"
        )
        queue = mcu.alloc_command_queue()
        self._commands = mcu.lookup_command("hd44780_send_cmds oid=%c cmds=%*s", cq=queue)
        self._data = mcu.lookup_command("hd44780_send_data oid=%c data=%*s", cq=queue)

    def send(self, data: Sequence[int], is_data: bool) -> None:
        (self._data if is_data else self._commands).send([self._oid, bytes(data)])


class ShiftRegisterTransport:
    """lcd_type hd44780_spi: D7 to D4 in bits 7 to 4 of the register, E in bit 3, RS in bit 1.

    Each byte takes hold of the register's outputs when the latch line rises after it.
    """

    ENABLE, DATA = 0x08, 0x02

    def __init__(self, config: ConfigWrapper) -> None:
        self.start = _four_bits(config)
        self._spi = bus.MCU_SPI_from_config(config, 0, pin_option="latch_pin")
        self.mcu = self._spi.get_mcu()

    def send(self, data: Sequence[int], is_data: bool) -> None:
        select = self.DATA if is_data else 0
        for value in data:
            for half in (value & 0xF0, value << 4 & 0xF0):
                self._spi.spi_send([half | select | self.ENABLE])
                self._spi.spi_send([half | select])


class WordTransport:
    """lcd_type aip31068_spi. Words that fill up the last byte are commands without effect."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.start = [(EIGHT_BITS_TWO_LINES, STEP_S), (EIGHT_BITS_TWO_LINES, STEP_S)]
        self._spi = bus.MCU_SPI_from_config(config, 0, pin_option="latch_pin")
        self.mcu = self._spi.get_mcu()

    def send(self, data: Sequence[int], is_data: bool) -> None:
        words = [is_data << 8 | value for value in data]
        for first in range(0, len(words), WORDS):
            group = words[first : first + WORDS]
            bits = 0
            for word in [0] * (WORDS - len(group)) + group:
                bits = bits << 9 | word
            self._spi.spi_send(bits.to_bytes(9, "big"))


class Hd44780:
    """`letters` is what the lines are to show; a glyph is loaded into its slot when a picture first has it."""

    rows = 4

    def __init__(self, transport: Transport, columns: int) -> None:
        self.mcu = transport.mcu
        self.columns = columns
        self._transport = transport
        self._line_addresses = (0x00, 0x40, columns, 0x40 + columns)
        self._slots: dict[int, tuple[int, ...]] = {}
        self._shown_slots: dict[int, tuple[int, ...]] = {}
        self._shown: Sequence[int] = ()
        self.erase()

    def erase(self) -> None:
        self.letters = bytearray(b" " * (self.rows * self.columns))

    def _put(self, row: int, column: int, code: int) -> None:
        if 0 <= row < self.rows and 0 <= column < self.columns:
            self.letters[row * self.columns + column] = code

    def put_text(self, row: int, column: int, text: str) -> None:
        for letter in text:
            plain = ord(letter) if " " <= letter <= "}" else ord("?")
            self._put(row, column, _LETTERS.get(letter, plain))
            column += 1

    def put_glyph(self, row: int, column: int, glyph: Glyph) -> int:
        if glyph.cell is None:
            self.put_text(row, column, glyph.letter or " ")
            return 1
        self._slots[glyph.slot] = tuple(glyph.cell)
        self._put(row, column, glyph.slot)
        return 1

    def put_bar(self, row: int, column: int, width: int, share: float) -> None:
        filled = round(min(1.0, max(0.0, share)) * width)
        for cell in range(width):
            self._put(row, column + cell, FULL_BLOCK if cell < filled else EMPTY_BLOCK)

    def start(self) -> Steps:
        yield START_S
        for command, wait_s in self._transport.start:
            self._transport.send([command], False)
            yield wait_s
        self._transport.send([DISPLAY_ON, RIGHTWARDS, CLEAR], False)
        yield STEP_S
        self._shown, self._shown_slots = b" " * len(self.letters), {}

    def changes(self) -> Steps:
        letters, slots = bytes(self.letters), dict(self._slots)
        for slot, cell in slots.items():
            if self._shown_slots.get(slot) != cell:
                self._transport.send([SLOT_ADDRESS | slot << 3], False)
                self._transport.send(cell, True)
                self._shown_slots[slot] = cell
                yield 0.0
        for row, address in enumerate(self._line_addresses):
            line = slice(row * self.columns, (row + 1) * self.columns)
            wanted = letters[line]
            for start, end in differences(self._shown[line], wanted, 2):
                for first in range(start, end, MESSAGE_BYTES):
                    self._transport.send([LETTER_ADDRESS | address + first], False)
                    self._transport.send(wanted[first : min(first + MESSAGE_BYTES, end)], True)
                    yield 0.0
        self._shown = letters


def _panel(transport: Callable[[ConfigWrapper], Transport]) -> Callable[[ConfigWrapper], Hd44780]:
    return lambda config: Hd44780(transport(config), config.getchoice("line_length", {16: 16, 20: 20}, 20))


TYPES: dict[str, Callable[[ConfigWrapper], Hd44780]] = {
    "hd44780": _panel(FirmwareTransport),
    "hd44780_spi": _panel(ShiftRegisterTransport),
    "aip31068_spi": _panel(WordTransport),
}
