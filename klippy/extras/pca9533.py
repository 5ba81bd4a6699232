"""[pca9533 NAME]: four LEDs on a chip on I2C; see led.py for colours and SET_LED.

Data sheet of the PCA9533: an LED is off, on, or at one of two duty cycles. So no more than two brightnesses between off
and on can show at a time: with more, each colour gets the nearer of the highest and the lowest.
"""

from __future__ import annotations

from collections.abc import Sequence

from configfile import ConfigWrapper

from . import bus
from .led import Color
from .leds.transmitter import Transmitter, level

FROM_PSC0 = 0x11  # the first register, with automatic increment: PSC0, PWM0, PSC1, PWM1, LS0
FASTEST = 0
OFF, ON, BLINK0, BLINK1 = range(4)


def registers(color: Color) -> bytes:
    """PSC0 to LS0 for red, green, blue and white at LED0 to LED3."""
    levels = [level(share) for share in color]
    between = [value for value in levels if 0 < value < 255] or [0]
    low, high = min(between), max(between)
    selector = 0
    for number, value in enumerate(levels):
        blink = BLINK0 if value - low <= high - value else BLINK1
        selector |= {0: OFF, 255: ON}.get(value, blink) << 2 * number
    return bytes([FASTEST, low, FASTEST, high, selector])


def load_config_prefix(config: ConfigWrapper) -> Transmitter:
    i2c = bus.MCU_I2C_from_config(config, 0x62)

    def send(colors: Sequence[Color], minclock: int) -> None:
        i2c.i2c_write([FROM_PSC0, *registers(colors[0])], minclock, minclock)

    return Transmitter(config, i2c.get_mcu(), send)
