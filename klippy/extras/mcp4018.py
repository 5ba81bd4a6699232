"""[mcp4018 NAME]: a potentiometer of 128 positions on I2C, set at start and by SET_DIGIPOT.

Data sheet of the MCP4017/18/19: address 0x2F, no register; a byte is the wiper's position.
"""

from __future__ import annotations

from configfile import ConfigWrapper
from gcode import GCodeCommand

from . import bus
from .digipots.codes import read_codes

ADDRESS = 0x2F
FULL_SCALE = 0x7F


class Mcp4018:
    """The chip NAME."""

    def __init__(self, config: ConfigWrapper) -> None:
        config.getfloat("wiper")  # must be given
        self._scale = config.getfloat("scale", 1.0, above=0.0)
        self._i2c = bus.MCU_I2C_from_config(config, ADDRESS, older_pins=True)
        self._i2c.i2c_write([read_codes(config, ("wiper",), FULL_SCALE)[0]])
        config.get_printer().lookup_object("gcode").register_mux_command(
            "SET_DIGIPOT",
            "DIGIPOT",
            config.get_name().split()[-1],
            self.cmd_SET_DIGIPOT,
            desc="Set the value of a digital potentiometer",
        )

    def cmd_SET_DIGIPOT(self, gcmd: GCodeCommand) -> None:
        """SET_DIGIPOT DIGIPOT=name WIPER=0..scale, at once."""
        wiper = gcmd.get_float("WIPER", minval=0.0, maxval=self._scale)
        self._i2c.i2c_write([int(wiper / self._scale * FULL_SCALE + 0.5)])


def load_config_prefix(config: ConfigWrapper) -> Mcp4018:
    return Mcp4018(config)
