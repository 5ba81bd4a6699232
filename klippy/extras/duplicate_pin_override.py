"""[duplicate_pin_override]: pins that several sections may use. pins.py reads it first of all; here it is checked."""

from __future__ import annotations

from typing import Any


class DuplicatePinOverride:
    """The object `duplicate_pin_override`."""

    def __init__(self, config: Any) -> None:
        pins = config.get_printer().lookup_object("pins")
        for description in config.getlist("pins"):
            pins.parse_pin(description)


def load_config(config: Any) -> DuplicatePinOverride:
    """Section [duplicate_pin_override]."""
    return DuplicatePinOverride(config)
