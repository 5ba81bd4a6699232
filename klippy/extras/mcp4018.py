"""[mcp4018 NAME]: a potentiometer of 128 positions on I2C, set at start.

Data sheet of the MCP4017/18/19: address 0x2F, no register; a byte is the wiper's position.
"""

from __future__ import annotations

from configfile import ConfigWrapper

from . import bus
from .digipots.codes import read_codes

ADDRESS = 0x2F
FULL_SCALE = 0x7F


def load_config_prefix(config: ConfigWrapper) -> None:
    config.getfloat("wiper")  # must be given
    i2c = bus.MCU_I2C_from_config(config, ADDRESS, older_pins=True)
    i2c.i2c_write([read_codes(config, ("wiper",), FULL_SCALE)[0]])
