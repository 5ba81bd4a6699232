"""lcd_type st7920 and emulated_st7920: 128 x 64 pixels, a character generator with ASCII beside a plane of pixels.

Letters of the chip's generator go as letters, two bytes a pair; all else is drawn into the pixel plane (GDRAM). The
ST7920 has a transport of its own in the firmware; a screen that emulates it takes the same bytes from plain SPI.

Data sheet of the ST7920: function set 0x30 basic, 0x36 extended with the pixel plane on; clear takes 1.6 ms, all else
72 us.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from configfile import ConfigWrapper

from .. import bus
from .panel import PixelCanvas, Steps, differences
from .pins import lookup_pins

BASIC, PIXELS, DISPLAY_ON, RIGHTWARDS, CLEAR, ADDRESS = 0x30, 0x36, 0x0C, 0x06, 0x01, 0x80
TEXT_ROWS = (0x00, 0x10, 0x08, 0x18)  # DDRAM addresses, of two letters each
SYNC_COMMAND, SYNC_DATA = 0xF8, 0xFA
BYTE_DELAY_S = 72e-6
START_S = 0.1  # the chip's own reset takes 40 ms
CLEAR_S = 0.01
MESSAGE_BYTES = 16  # the firmware is busy for 1.4 ms with so many
EMULATED_SPEED_HZ = 1000000


class Transport(Protocol):
    """Brings bytes to the chip."""

    mcu: Any

    def send(self, data: Sequence[int], is_data: bool) -> None: ...


class FirmwareTransport:
    """The firmware makes the frames of the serial interface (src/lcd_st7920.c)."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.mcu, (cs, sclk, sid) = lookup_pins(config, ("cs_pin", "sclk_pin", "sid_pin"))
        self._oid = self.mcu.create_oid()
        self._cs, self._sclk, self._sid = cs, sclk, sid
        self._commands: Any = None
        self._data: Any = None
        self.mcu.register_config_callback(self._build_config)

    def _build_config(self) -> None:
        mcu = self.mcu
        delay_ticks = mcu.seconds_to_clock(BYTE_DELAY_S)
        mcu.add_config_cmd(
            f"config_st7920 oid={self._oid} cs_pin={self._cs} sclk_pin={self._sclk} sid_pin={self._sid}"
            f" sync_delay_ticks={delay_ticks} cmd_delay_ticks={delay_ticks}"
        )
        queue = mcu.alloc_command_queue()
        self._commands = mcu.lookup_command("st7920_send_cmds oid=%c cmds=%*s", cq=queue)
        self._data = mcu.lookup_command("st7920_send_data oid=%c data=%*s", cq=queue)

    def send(self, data: Sequence[int], is_data: bool) -> None:
        (self._data if is_data else self._commands).send([self._oid, bytes(data)])


class SpiTransport:
    """The same frames on SPI; the select line is high during a message."""

    def __init__(self, config: ConfigWrapper) -> None:
        self._spi = bus.MCU_SPI_from_config(
            config, 0, pin_option="en_pin", default_speed=EMULATED_SPEED_HZ, cs_active_high=True
        )
        self.mcu = self._spi.get_mcu()

    def send(self, data: Sequence[int], is_data: bool) -> None:
        frame = [SYNC_DATA if is_data else SYNC_COMMAND]
        for value in data:
            frame += [value & 0xF0, value << 4 & 0xF0]
        self._spi.spi_send(frame)


class St7920(PixelCanvas):
    """`letters` is what DDRAM is to hold, `pixels` what GDRAM is."""

    def __init__(self, transport: Transport) -> None:
        super().__init__()
        self.mcu = transport.mcu
        self._transport = transport
        self._shown_letters: Sequence[int] = ()
        self._shown_pixels: Sequence[int] = ()
        self.erase()

    def erase(self) -> None:
        super().erase()
        self.letters = bytearray(b" " * 64)

    def put_text(self, row: int, column: int, text: str) -> None:
        for letter in text:
            if not " " <= letter <= "~":
                super().put_text(row, column, letter)
            elif 0 <= row < self.rows and 0 <= column < self.columns:
                self.letters[row * 16 + column] = ord(letter)
            column += 1

    def start(self) -> Steps:
        yield START_S
        self._transport.send([BASIC, BASIC, DISPLAY_ON, RIGHTWARDS, CLEAR], False)
        yield CLEAR_S
        # Data sheet: the bit that chooses the extended set and the one for pixels cannot change together
        self._transport.send([PIXELS, PIXELS], False)
        self._shown_letters, self._shown_pixels = b" " * 64, [-1] * 1024  # unknown

    def changes(self) -> Steps:
        yield from self._send_letters(bytes(self.letters))
        yield from self._send_pixels(bytes(self.pixels))

    def _send_letters(self, letters: bytes) -> Steps:
        for row, first in enumerate(TEXT_ROWS):
            shown, wanted = self._shown_letters[row * 16 : row * 16 + 16], letters[row * 16 : row * 16 + 16]
            for start, end in differences(shown, wanted, 4):
                pair = start // 2
                self._transport.send([BASIC, ADDRESS | first + pair], False)
                self._transport.send(wanted[2 * pair : end + end % 2], True)
                yield 0.0
        self._shown_letters = letters

    def _send_pixels(self, pixels: bytes) -> Steps:
        for line in range(32):  # the lower half follows the upper one in the same lines
            upper, lower = slice(16 * line, 16 * line + 16), slice(512 + 16 * line, 528 + 16 * line)
            shown = [*self._shown_pixels[upper], *self._shown_pixels[lower]]
            wanted = pixels[upper] + pixels[lower]
            for start, end in differences(shown, wanted, 4):
                for first in range(start - start % 2, end, MESSAGE_BYTES):
                    stop = min(first + MESSAGE_BYTES, end + end % 2)
                    self._transport.send([PIXELS, ADDRESS | line, ADDRESS | first // 2], False)
                    self._transport.send(wanted[first:stop], True)
                    yield 0.0
        self._shown_pixels = pixels


TYPES: dict[str, Callable[[ConfigWrapper], St7920]] = {
    "st7920": lambda config: St7920(FirmwareTransport(config)),
    "emulated_st7920": lambda config: St7920(SpiTransport(config)),
}
