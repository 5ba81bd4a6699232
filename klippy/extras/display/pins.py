"""Pins of a display that are not on a bus."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from configfile import ConfigWrapper


def lookup_pins(config: ConfigWrapper, options: Sequence[str]) -> tuple[Any, list[str]]:
    """The board and the pins of options that must all be on it."""
    lookup = config.get_printer().lookup_object("pins").lookup_pin
    params = [lookup(config.get(option)) for option in options]
    mcu = params[0]["chip"]
    for option, pin in zip(options, params, strict=True):
        if pin["chip"] is not mcu:
            raise config.error(
                f"Option '{option}' in section '{config.get_name()}': all pins of a display must be on one board,"
                f" {options[0]} is on '{mcu.get_name()}' ({config.where(option)})."
            )
    return mcu, [pin["pin"] for pin in params]
