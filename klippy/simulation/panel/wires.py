"""From the events on a display's lines in the world to what its chip gets: commands, data, frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .chips import ChipError, Hd44780, PageChip, Picture, St7920

BYTE, SELECTED, RELEASED, RESET = range(4)  # enum world_panel_event

Take = Callable[[int, int, bool], None]  # event, value, level of the line that is high for data


class Wires:
    """A chip behind its lines. `lcd_type` as in [display]."""

    def __init__(self, lcd_type: str, columns: int = 20, first_column: int = 0) -> None:
        self.chip: Any  # St7920, Hd44780 or PageChip
        self.take: Take
        if lcd_type in ("st7920", "emulated_st7920"):
            self.chip = St7920()
            self.take = _serial(self.chip)
        elif lcd_type in _CHARACTER:
            self.chip = Hd44780(columns, lcd_type != "aip31068_spi")
            self.take = _CHARACTER[lcd_type](self.chip)
        else:
            self.chip = PageChip(lcd_type, first_column)
            self.take = _pages(self.chip)

    def picture(self) -> Picture:
        picture: Picture = self.chip.picture()
        return picture


def _serial(chip: St7920) -> Take:
    def take(event: int, value: int, is_data: bool) -> None:
        if event == SELECTED:
            chip.select()
        elif event == BYTE:
            chip.serial_byte(value)

    return take


def _four_lines(chip: Hd44780) -> Take:
    def take(event: int, value: int, is_data: bool) -> None:
        if event == BYTE:
            chip.strobe(value, is_data)

    return take


def shift_register(chip: Hd44780) -> Take:
    """The 74HC595 of a MightyBoard: its outputs change when it is released; D7 to D4, E in bit 3, RS in bit 1."""
    shifted = outputs = 0

    def take(event: int, value: int, is_data: bool) -> None:
        nonlocal shifted, outputs
        if event == BYTE:
            shifted = value
        elif event == RELEASED:
            if outputs & ~shifted & 0x08:
                chip.strobe(outputs >> 4, bool(outputs & 0x02))
            outputs = shifted

    return take


def words(chip: Hd44780) -> Take:
    """Words of nine bits, RS first, from one selection to its end."""
    frame = bytearray()

    def take(event: int, value: int, is_data: bool) -> None:
        if event == SELECTED:
            frame.clear()
        elif event == BYTE:
            frame.append(value)
        elif event == RELEASED:
            count, rest = divmod(8 * len(frame), 9)
            if rest:
                raise ChipError(f"{len(frame)} bytes are not whole words of nine bits")
            bits = int.from_bytes(frame, "big")
            for number in reversed(range(count)):
                word = bits >> 9 * number & 0x1FF
                chip.byte(word & 0xFF, bool(word >> 8))

    return take


def _pages(chip: PageChip) -> Take:
    def take(event: int, value: int, is_data: bool) -> None:
        if event == RESET:
            chip.reset()
        elif event == BYTE:
            (chip.data if is_data else chip.command)(value)

    return take


def with_control_byte(take: Take) -> Take:
    """I2C: the first byte after the address says whether commands or data follow."""
    control: int | None = None

    def taken(event: int, value: int, is_data: bool) -> None:
        nonlocal control
        if event != BYTE:
            control = None
        elif control is None:
            control = value
            if value not in (0x00, 0x40):
                raise ChipError(f"{value:#x} is no control byte")
        else:
            take(event, value, control == 0x40)

    return taken


_CHARACTER: dict[str, Callable[[Hd44780], Take]] = {
    "hd44780": _four_lines,
    "hd44780_spi": shift_register,
    "aip31068_spi": words,
}
