"""[duplicate_pin_override]: pins that several sections may use. pins.py reads it first of all; here it is checked."""

from __future__ import annotations

from configfile import ConfigWrapper


class DuplicatePinOverride:
    """The object `duplicate_pin_override`."""

    def __init__(self, config: ConfigWrapper) -> None:
        pins = config.get_printer().lookup_object("pins")
        for description in config.getlist("pins"):
            pins.parse_pin(description)


def load_config(config: ConfigWrapper) -> DuplicatePinOverride:
    """Section [duplicate_pin_override]."""
    return DuplicatePinOverride(config)
