"""[neopixel NAME]: a chain of WS2812 (Neopixel) LEDs; see led.py for colours and SET_LED.

The MCU keeps the chain's bytes. The host sends it those that have changed, then the order to transmit. A transmission
that an interrupt of the MCU has spoilt is repeated.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from configfile import ConfigWrapper

from .led import Color

BIT_MAX_TIME_S = 0.000004  # a longer low and the LEDs latch (WS2812B: at the earliest after 5 us)
RESET_MIN_TIME_S = 0.000050  # WS2812 data sheet; later types need 280 us
MCU_DATA_MAX = 500  # bytes of one chain: the MCU's memory is small
UPDATE_BYTES_MAX = 48  # of one message
GAP_MAX = 5  # unchanged bytes between two changed ones that cost less than another message
TRIES = 8

_BYTE_OF = {"R": 0, "G": 1, "B": 2, "W": 3}


def parse_color_order(orders: Sequence[str], count: int) -> list[int]:
    """Index of the colour (0 red … 3 white) of each byte of one LED after another, with 4 * LED added.

    Raises ValueError for an order that is none.
    """
    if len(orders) == 1:
        orders = list(orders) * count
    if len(orders) != count:
        raise ValueError(f"color_order has {len(orders)} entries for {count} LEDs")
    places = []
    for led, order in enumerate(orders):
        if sorted(order.upper()) not in (sorted("RGB"), sorted("RGBW")):
            raise ValueError(f"color_order '{order}' is no order of R, G, B and maybe W")
        places += [4 * led + _BYTE_OF[letter] for letter in order.upper()]
    return places


def changed_spans(old: bytes, new: bytes) -> list[tuple[int, bytes]]:
    """(position, bytes) messages that turn `old` into `new`."""
    spans: list[tuple[int, int]] = []
    for i, (a, b) in enumerate(zip(old, new, strict=True)):
        if a == b:
            continue
        joins = spans and i - spans[-1][1] <= GAP_MAX and i + 1 - spans[-1][0] <= UPDATE_BYTES_MAX
        if joins:
            spans[-1] = (spans[-1][0], i + 1)
        else:
            spans.append((i, i + 1))
    return [(start, new[start:end]) for start, end in spans]


class PrinterNeopixel:
    """The object `neopixel NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = printer = config.get_printer()
        self.reactor = printer.get_reactor()
        self.name = config.get_name()
        params = printer.lookup_object("pins").lookup_pin(config.get("pin"))
        self.mcu = params["chip"]
        self.pin = params["pin"]
        count = config.getint("chain_count", 1, minval=1)
        try:
            self._places = parse_color_order(config.getlist("color_order", ("GRB",)), count)
        except ValueError as e:
            raise config.error(f"Section '{self.name}': {e}.") from None
        if len(self._places) > MCU_DATA_MAX:
            raise config.error(f"Section '{self.name}': a chain of {count} LEDs is too long for the board.")
        self.led_helper = printer.load_object(config, "led").setup_helper(config, self._update, count)
        self.get_status = self.led_helper.get_status
        self._mutex = self.reactor.mutex()
        self._wanted = self._encode(self.led_helper.led_state)
        self._sent = bytes(len(self._places))
        self._update_cmd: Any = None
        self._send_cmd: Any = None
        self.oid = self.mcu.create_oid()
        self.mcu.register_config_callback(self._build_config)

    def register(self) -> None:
        """The first colours go out as soon as the MCU is there."""
        self.printer.register_event_handler("klippy:connect", self._handle_connect)

    def _encode(self, led_state: Sequence[Color]) -> bytes:
        return bytes(int(led_state[place // 4][place % 4] * 255.0 + 0.5) for place in self._places)

    def _build_config(self) -> None:
        mcu, oid = self.mcu, self.oid
        mcu.add_config_cmd(
            f"config_neopixel oid={oid} pin={self.pin} data_size={len(self._places)}"
            f" bit_max_ticks={mcu.seconds_to_clock(BIT_MAX_TIME_S)}"
            f" reset_min_ticks={mcu.seconds_to_clock(RESET_MIN_TIME_S)}"
        )
        queue = mcu.alloc_command_queue()
        self._update_cmd = mcu.lookup_command("neopixel_update oid=%c pos=%hu data=%*s", cq=queue)
        self._send_cmd = mcu.lookup_query_command(
            "neopixel_send oid=%c", "neopixel_result oid=%c success=%c", oid=oid, cq=queue
        )

    def _handle_connect(self) -> None:
        # an MCU configured before may hold any colours: everything is sent
        self._sent = bytes(byte ^ 0xFF for byte in self._wanted)
        self._update(self.led_helper.led_state, None)

    def _update(self, led_state: Sequence[Color], print_time: float | None) -> None:
        wanted = self._encode(led_state)
        self.reactor.register_callback(lambda eventtime: self._send(wanted, print_time))

    def _send(self, wanted: bytes, print_time: float | None) -> None:
        with self._mutex:
            if self._update_cmd is None or self.printer.is_shutdown():
                return
            minclock = 0 if print_time is None else self.mcu.print_time_to_clock(print_time)
            for position, data in changed_spans(self._sent, wanted):
                self._update_cmd.send([self.oid, position, data], minclock=minclock, reqclock=minclock)
            self._sent = self._wanted = wanted
            for _ in range(TRIES):
                params = self._send_cmd.send([self.oid], minclock=minclock, reqclock=minclock)
                if params["success"] or self.mcu.is_fileoutput():
                    return
            logging.info("%s: the LEDs could not be set, the board is too busy", self.name)


def load_config_prefix(config: ConfigWrapper) -> PrinterNeopixel:
    """Section [neopixel NAME]."""
    neopixel = PrinterNeopixel(config)
    neopixel.register()
    return neopixel
