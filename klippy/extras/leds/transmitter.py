"""Brings the colours of [led]'s commands to a chip on a bus, one transmission after another."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

from configfile import ConfigWrapper

from ..led import Color

Send = Callable[[Sequence[Color], int], None]  # colours, and the clock from which on they hold (0: at once)


def level(share: float) -> int:
    """A colour's share in steps of 255."""
    return int(share * 255.0 + 0.5)


class Transmitter:
    """A section's LEDs. `send` is called in the reactor, and once while the config is read: for each start."""

    def __init__(self, config: ConfigWrapper, mcu: Any, send: Send, led_count: int = 1) -> None:
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.name = config.get_name()
        self._mcu, self._send = mcu, send
        self._mutex = self.reactor.mutex()
        leds = self.printer.load_object(config, "led")
        self.led_helper = leds.setup_helper(config, self._update, led_count)
        self.get_status = self.led_helper.get_status
        send(self.led_helper.led_state, 0)

    def _update(self, led_state: Sequence[Color], print_time: float | None) -> None:
        clock = 0 if print_time is None else self._mcu.print_time_to_clock(print_time)
        colors = list(led_state)
        self.reactor.register_callback(lambda eventtime: self._transmit(colors, clock))

    def _transmit(self, colors: Sequence[Color], clock: int) -> None:
        with self._mutex:
            if self.printer.is_shutdown():
                return
            try:
                self._send(colors, clock)
            except self.printer.command_error as e:
                logging.warning("%s: the LEDs could not be set: %s", self.name, e)
