"""[dac084S085 NAME]: four 8-bit DACs on SPI, set at start.

Data sheet of the DAC084S085: 16 bits, taken at the falling edge of the clock: channel (2 bits), operation (2), value
(8), 4 without meaning.
"""

from __future__ import annotations

from configfile import ConfigWrapper

from . import bus
from .digipots.codes import read_codes

CHANNELS = ("channel_A", "channel_B", "channel_C", "channel_D")
WRITE_AND_UPDATE = 0b01


def load_config_prefix(config: ConfigWrapper) -> None:
    spi = bus.MCU_SPI_from_config(config, 1, pin_option="enable_pin", default_speed=10000000)
    for channel, code in read_codes(config, CHANNELS, 0xFF).items():
        word = channel << 14 | WRITE_AND_UPDATE << 12 | code << 4
        spi.spi_send(word.to_bytes(2, "big"))
