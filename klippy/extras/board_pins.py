"""[board_pins] and [board_pins NAME]: other names for the pins of a board.

    mcu: mcu                                  (a list: the aliases hold for each of these boards)
    aliases: EXP1_1=PE8, EXP1_2=PE7, EXP1_9=<GND>
    aliases_exp2: ...                         any number of further lists

A value in <angle brackets> is not a pin: the alias is reserved, so that using it is an error with that name.
"""

from __future__ import annotations

from configfile import ConfigWrapper


class PrinterBoardAliases:
    """The object `board_pins`."""

    def __init__(self, config: ConfigWrapper) -> None:
        pins = config.get_printer().lookup_object("pins")
        resolvers = [pins.get_pin_resolver(name) for name in config.getlist("mcu", ("mcu",))]
        options = ["aliases", *config.get_prefix_options("aliases_")]
        for option in options:
            for pair in config.getlists(option, (), seps=("=", ","), count=2):
                alias, value = pair
                for resolver in resolvers:
                    if value.startswith("<") and value.endswith(">"):
                        resolver.reserve_pin(alias, value)
                    else:
                        resolver.alias_pin(alias, value)


def load_config(config: ConfigWrapper) -> PrinterBoardAliases:
    """Section [board_pins]."""
    return PrinterBoardAliases(config)


def load_config_prefix(config: ConfigWrapper) -> PrinterBoardAliases:
    """Section [board_pins NAME]."""
    return PrinterBoardAliases(config)
