"""[mcp4451 NAME]: four potentiometers of 257 positions on I2C, set at start.

Data sheet of the MCP444X/445X: register (4 bits), command (2, write is 0), the value's 10 bits.
"""

from __future__ import annotations

from configfile import ConfigWrapper

from . import bus
from .digipots.codes import read_codes

WIPERS = ("wiper_0", "wiper_1", "wiper_2", "wiper_3")
REGISTERS = (0x0, 0x1, 0x6, 0x7)  # of the volatile wipers
FULL_SCALE = 0x100


def load_config_prefix(config: ConfigWrapper) -> None:
    i2c = bus.MCU_I2C_from_config(config)
    for wiper, code in read_codes(config, WIPERS, FULL_SCALE).items():
        i2c.i2c_write((REGISTERS[wiper] << 12 | code).to_bytes(2, "big"))
