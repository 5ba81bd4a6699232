"""A board that may vanish and return: `[mcu NAME]` with `is_non_critical: True`.

    connected ──► lose(): silent for seconds, or reset ──► absent ──► come_back() every few seconds ──► connected

While a board is absent, its commands go nowhere and its queries fail at once (serialhdl.py). G-code commands for its
pins are refused. A board that returns is configured anew; its outputs get the values they last had.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import msgproto
import pins
import serialhdl

from . import serialport

CONNECT_S = 3.0  # a board that is absent at the start holds the others up no longer


def refuse(config: Any, option: str) -> None:
    """The pin of this option may not be on a board that may vanish: motion and heat need theirs."""
    pin_desc = config.get(option, None)
    chip, colon, _ = (pin_desc or "").rpartition(":")
    section = f"mcu {chip.strip('^~! ')}"
    if not colon or not config.has_section(section):
        return
    if config.getsection(section).getboolean("is_non_critical", False):
        raise config.error(
            f"Option '{option}' in section '{config.get_name()}' ({config.where(option)}): the board of pin"
            f" '{pin_desc}' may vanish ([{section}] is_non_critical), but motors and heaters need theirs all the time."
            " Use a pin of another board, or remove is_non_critical."
        )


def require_connected(mcu: Any) -> None:
    """Raise command_error if the board of a pin is absent. A chip made by a plugin is always there."""
    check = getattr(mcu, "require_connected", None)
    if check is not None:
        check()


class OptionalBoard:
    """Whether the board is there; looks for it while it is not."""

    def __init__(
        self, printer: Any, name: str, interval_s: float, serial: Any, come_back: Callable[[], None]
    ) -> None:
        self._printer, self._name, self._interval_s = printer, name, interval_s
        self._reactor = printer.get_reactor()
        self._serial, self._come_back = serial, come_back
        self._is_looking = False
        self._reported = ""

    @property
    def is_absent(self) -> bool:
        return bool(self._serial.is_absent)

    def require(self) -> None:
        """Raise command_error while the board is absent."""
        if self.is_absent:
            raise self._printer.command_error(
                f"MCU '{self._name}' is not connected: check its cable and its supply. It is looked for every"
                f" {self._interval_s:g} s."
            )

    def lose(self, reason: str) -> None:
        """The board is gone."""
        if self.is_absent:
            return
        self._serial.is_absent = True
        self._announce(f"MCU '{self._name}' is not connected ({reason}). The printer goes on without it.")
        self._printer.send_event(f"mcu:{self._name}:disconnected")

    def look(self) -> None:
        """Look for the board until it is back."""
        if not self._is_looking:
            self._is_looking = True
            self._reactor.register_callback(self._look, self._reactor.monotonic() + self._interval_s)

    def stop(self) -> None:
        """The host ends, or starts again."""
        self._is_looking = False

    def _look(self, eventtime: float) -> None:
        if not self._is_looking:
            return
        self._is_looking = False
        try:
            self._come_back()
        except (
            serialhdl.error,
            serialport.PortError,
            msgproto.error,
            pins.error,
            self._printer.config_error,
        ) as e:
            self._serial.disconnect()
            if str(e) != self._reported:
                self._reported = str(e)
                logging.info("MCU '%s': %s", self._name, e)
            self.look()
            return
        self._reported = ""
        self._serial.is_absent = False
        self._announce(f"MCU '{self._name}' is connected again.")
        self._printer.send_event(f"mcu:{self._name}:reconnected")

    def _announce(self, text: str) -> None:
        logging.warning("%s", text)
        self._printer.lookup_object("gcode").respond_info(text, log=False)
