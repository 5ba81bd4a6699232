"""[dotstar NAME]: a chain of APA102 LEDs on two pins; see led.py for colours and SET_LED.

Data sheet of the APA102: 32 bits of 0, then 32 bits for each LED (three ones, 5 bits of brightness, blue, green, red).
Each LED delays the data by half a clock, so half a clock for each LED must follow; ones, which change nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

from configfile import ConfigWrapper

from . import bus
from .led import Color
from .leds.transmitter import Transmitter, level

SPEED_HZ = 500000
FULL_BRIGHTNESS = 0xFF
MESSAGE_BYTES_MAX = 40
CHAIN_MAX = 500


def chain_bytes(colors: Sequence[Color]) -> bytes:
    """What the chain is sent."""
    leds = b"".join(
        bytes([FULL_BRIGHTNESS, level(blue), level(green), level(red)]) for red, green, blue, _ in colors
    )
    return bytes(4) + leds + b"\xff" * ((len(colors) + 15) // 16)


def load_config_prefix(config: ConfigWrapper) -> Transmitter:
    pins = config.get_printer().lookup_object("pins")
    data, clock = (pins.lookup_pin(config.get(option)) for option in ("data_pin", "clock_pin"))
    mcu = data["chip"]
    if clock["chip"] is not mcu:
        raise config.error(
            f"Section '{config.get_name()}': data_pin and clock_pin must be on the same board"
            f" ({config.where('clock_pin')})."
        )
    # there is no line back: the data pin stands in for it, and is an output in the end
    lines = bus.SpiPins(data["pin"], data["pin"], clock["pin"])
    spi = bus.MCU_SPI(mcu, None, None, 0, SPEED_HZ, lines)

    def send(colors: Sequence[Color], minclock: int) -> None:
        content = chain_bytes(colors)
        for start in range(0, len(content), MESSAGE_BYTES_MAX):
            spi.spi_send(content[start : start + MESSAGE_BYTES_MAX], minclock, minclock)

    return Transmitter(config, mcu, send, config.getint("chain_count", 1, minval=1, maxval=CHAIN_MAX))
