"""[mcp4728 NAME]: four 12-bit DACs on I2C, set at start.

Data sheet of the MCP4728, "Multi-Write": command and channel, then reference (1: the internal 2.048 V), power-down (2),
gain (0: once) and 12 bits of value. The EEPROM stays as it is. Outputs change at once.
"""

from __future__ import annotations

from configfile import ConfigWrapper

from . import bus
from .digipots.codes import read_codes

CHANNELS = ("channel_a", "channel_b", "channel_c", "channel_d")
MULTI_WRITE = 0x40
INTERNAL_REFERENCE = 0x8000


def load_config_prefix(config: ConfigWrapper) -> None:
    i2c = bus.MCU_I2C_from_config(config, 0x60)
    for channel, code in read_codes(config, CHANNELS, 0xFFF).items():
        i2c.i2c_write([MULTI_WRITE | channel << 1, *(INTERNAL_REFERENCE | code).to_bytes(2, "big")])
