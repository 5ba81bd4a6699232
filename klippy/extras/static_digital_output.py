"""[static_digital_output NAME]: pins set once at start, high or (with !) low."""

from __future__ import annotations

from configfile import ConfigWrapper


class PrinterStaticDigitalOut:
    """The object `static_digital_output NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        pins = config.get_printer().lookup_object("pins")
        for description in config.getlist("pins"):
            params = pins.lookup_pin(description, can_invert=True)
            value = 0 if params["invert"] else 1
            params["chip"].add_config_cmd(f"set_digital_out pin={params['pin']} value={value}")


def load_config_prefix(config: ConfigWrapper) -> PrinterStaticDigitalOut:
    """Section [static_digital_output NAME]."""
    return PrinterStaticDigitalOut(config)
