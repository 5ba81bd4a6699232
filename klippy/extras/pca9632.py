"""[pca9632 NAME]: four LEDs on a chip on I2C; see led.py for colours and SET_LED.

Data sheet of the PCA9632: MODE1 ends its sleep, LEDOUT gives each LED the duty cycle of its PWM register. The outputs
drive transistors, as for LED strips: inverted, totem pole.
"""

from __future__ import annotations

from collections.abc import Sequence

from configfile import ConfigWrapper

from . import bus
from .led import Color
from .leds.transmitter import Transmitter, level

INCREMENT = 0x80
MODE1, PWM0, LEDOUT = 0x00, 0x02, 0x08
AWAKE, INVERTED_TOTEM_POLE = 0x00, 0x15
ALL_BY_PWM = 0xAA


def load_config_prefix(config: ConfigWrapper) -> Transmitter:
    order = config.get("color_order", "RGBW").upper()
    if sorted(order) != sorted("RGBW"):
        raise config.error(
            f"Option 'color_order' in section '{config.get_name()}': '{order}' is not an order of R, G, B and W,"
            f" such as RGBW ({config.where('color_order')})."
        )
    places = ["RGBW".index(letter) for letter in order]
    i2c = bus.MCU_I2C_from_config(config, 0x62, older_pins=True)
    i2c.i2c_write([INCREMENT | MODE1, AWAKE, INVERTED_TOTEM_POLE])
    i2c.i2c_write([LEDOUT, ALL_BY_PWM])

    def send(colors: Sequence[Color], minclock: int) -> None:
        levels = [level(colors[0][place]) for place in places]
        i2c.i2c_write([INCREMENT | PWM0, *levels], minclock, minclock)

    return Transmitter(config, i2c.get_mcu(), send)
