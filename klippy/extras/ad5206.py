"""[ad5206 NAME]: six potentiometers of 256 positions on SPI, set at start.

Data sheet of the AD5204/AD5206: 11 bits, high bit first: address (channel 1 is 0), value. Bits before these are lost.
"""

from __future__ import annotations

from configfile import ConfigWrapper

from . import bus
from .digipots.codes import read_codes

CHANNELS = tuple(f"channel_{number}" for number in range(1, 7))


def load_config_prefix(config: ConfigWrapper) -> None:
    spi = bus.MCU_SPI_from_config(config, 0, pin_option="enable_pin", default_speed=25000000)
    for address, code in read_codes(config, CHANNELS, 0xFF).items():
        spi.spi_send([address, code])
