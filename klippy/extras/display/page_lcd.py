"""Chips whose pixels lie in 8 pages of 8 lines, a byte a column with the upper pixel in bit 0: uc1701, ssd1306, sh1106.

Data sheets: UltraChip UC1701x, Solomon SSD1306 (page addressing), Sino Wealth SH1106. In all three 0xB0 chooses the
page, 0x10 and 0x00 the halves of the column.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from configfile import ConfigWrapper

from .. import bus
from .panel import PixelCanvas, Steps, differences

PAGE, COLUMN_HIGH, COLUMN_LOW = 0xB0, 0x10, 0x00
PAGES, PAGE_BYTES = 8, 128
MESSAGE_BYTES = 32
RESET_S, START_S = 0.1, 0.1  # data sheets: low for some microseconds; then the supply settles
SPI_SPEED_HZ = 10000000
I2C_ADDRESS, I2C_SPEED_HZ = 60, 400000
I2C_COMMANDS, I2C_DATA = 0x00, 0x40
SH1106_COLUMNS = 132


class Transport(Protocol):
    """Brings bytes to the chip."""

    mcu: Any

    def send(self, data: Sequence[int], is_data: bool) -> None: ...


class SpiTransport:
    """Four lines: a data line beside the bus says whether bytes are commands or data."""

    def __init__(self, config: ConfigWrapper, data_option: str) -> None:
        self._spi = bus.MCU_SPI_from_config(config, 0, default_speed=SPI_SPEED_HZ)
        self.mcu = self._spi.get_mcu()
        self._data_line = bus.MCU_bus_digital_out(
            self.mcu, config.get(data_option), self._spi.get_command_queue()
        )
        self._level = 0

    def send(self, data: Sequence[int], is_data: bool) -> None:
        if self._level != is_data:
            self._level = int(is_data)
            self._data_line.update_digital_out(self._level)
        self._spi.spi_send(data)


class I2cTransport:
    """A control byte goes before the bytes. Each message is answered."""

    def __init__(self, config: ConfigWrapper) -> None:
        self._i2c = bus.MCU_I2C_from_config(config, I2C_ADDRESS, I2C_SPEED_HZ)
        self.mcu = self._i2c.get_mcu()

    def send(self, data: Sequence[int], is_data: bool) -> None:
        self._i2c.i2c_write([I2C_DATA if is_data else I2C_COMMANDS, *data])


class ResetPin:
    """The chip's reset line, low to reset; without one the board holds it high."""

    def __init__(self, config: ConfigWrapper, option: str, mcu: Any) -> None:
        pin = config.get(option, None)
        self._pin = None if pin is None else bus.MCU_bus_digital_out(mcu, pin, value=0)

    def pulse(self) -> Steps:
        """Reset the chip."""
        if self._pin is not None:
            self._pin.update_digital_out(0)
            yield RESET_S
            self._pin.update_digital_out(1)
        yield START_S


class PageLcd(PixelCanvas):
    """`settings` sets the chip up; its first column of pixels is `offset`, of `width` the chip has."""

    def __init__(
        self,
        transport: Transport,
        reset: ResetPin,
        settings: Sequence[int],
        offset: int = 0,
        width: int = 128,
    ) -> None:
        super().__init__()
        self.mcu = transport.mcu
        self._transport, self._reset, self._settings = transport, reset, settings
        self._offset, self._width = offset, width
        self._shown: list[Sequence[int]] = []

    def start(self) -> Steps:
        yield from self._reset.pulse()
        self._transport.send(self._settings, False)
        yield START_S
        unknown = [-1] * PAGE_BYTES
        self._shown = [unknown] * PAGES
        if self._width > PAGE_BYTES:  # columns beside the glass
            for page in range(PAGES):
                yield from self._send(page, 0, bytes(self._width))

    def changes(self) -> Steps:
        for page in range(PAGES):
            wanted = columns_of(self.pixels[page * 128 : page * 128 + 128])
            for start, end in differences(self._shown[page], wanted, 6):
                yield from self._send(page, start + self._offset, wanted[start:end])
            self._shown[page] = wanted

    def _send(self, page: int, column: int, data: bytes) -> Steps:
        for first in range(0, len(data), MESSAGE_BYTES):
            place = column + first
            self._transport.send([PAGE | page, COLUMN_HIGH | place >> 4, COLUMN_LOW | place & 0x0F], False)
            self._transport.send(data[first : first + MESSAGE_BYTES], True)
            yield 0.0


def columns_of(lines: Sequence[int]) -> bytes:
    """Eight lines of 16 bytes as 128 columns, the upper pixel in bit 0."""
    columns = bytearray(PAGE_BYTES)
    for line in range(8):
        for cell in range(16):
            bits = lines[line * 16 + cell]
            place = cell * 8 + 7
            while bits:
                if bits & 1:
                    columns[place] |= 1 << line
                bits >>= 1
                place -= 1
    return bytes(columns)


def uc1701(config: ConfigWrapper) -> PageLcd:
    """lcd_type uc1701. Data sheet: 1/9 bias, booster and regulators on, resistor ratio 5."""
    contrast = config.getint("contrast", 40, minval=0, maxval=63)
    transport = SpiTransport(config, "a0_pin")
    settings = [
        *(0xE2, 0x40, 0xA0, 0xC8, 0xA6, 0xA2),  # reset; first line 0; columns as they are, lines from below
        *(0x2F, 0xF8, 0x00, 0x25, 0x81, contrast),  # supply on, booster x4; ratio, contrast
        *(0xAC, 0x00, 0xA4, 0xAF),  # no indicator; pixels from memory; on
    ]
    return PageLcd(transport, ResetPin(config, "rst_pin", transport.mcu), settings)


def _oled(config: ConfigWrapper) -> tuple[SpiTransport | I2cTransport, ResetPin, list[int]]:
    """What ssd1306 and sh1106 have in common: bus, reset line, settings after the supply."""
    by_spi = config.get("cs_pin", None) is not None
    transport = SpiTransport(config, "dc_pin") if by_spi else I2cTransport(config)
    contrast = min(255, config.getint("contrast", 239, minval=0, maxval=256))
    settings = [
        *(0xA1, 0xC8, 0xDA, 0x12, 0x81, contrast),  # columns from the right, lines from below; contrast
        *(0xD9, 0xA1, 0xDB, config.getint("vcomh", 0, minval=0, maxval=63)),  # precharge
        *(0xA4, 0xA7 if config.getboolean("invert", False) else 0xA6, 0xAF),  # from memory; on
    ]
    return transport, ResetPin(config, "reset_pin", transport.mcu), settings


_OLED_START = (0xAE, 0xD5, 0x80, 0xA8, 0x3F, 0xD3, 0x00, 0x40)  # off; clock, 64 lines, no shift


def ssd1306(config: ConfigWrapper) -> PageLcd:
    """lcd_type ssd1306: charge pump on, page addressing."""
    transport, reset, settings = _oled(config)
    return PageLcd(transport, reset, [*_OLED_START, 0x8D, 0x14, 0x20, 0x02, 0x2E, *settings])


def sh1106(config: ConfigWrapper) -> PageLcd:
    """lcd_type sh1106: DC-DC converter on; more columns than the glass has."""
    transport, reset, settings = _oled(config)
    offset = config.getint("x_offset", 0, minval=0, maxval=SH1106_COLUMNS - PAGE_BYTES)
    return PageLcd(transport, reset, [*_OLED_START, 0xAD, 0x8B, *settings], offset, SH1106_COLUMNS)


TYPES: dict[str, Callable[[ConfigWrapper], PageLcd]] = {
    "uc1701": uc1701,
    "ssd1306": ssd1306,
    "sh1106": sh1106,
}
