"""QUERY_ADC [NAME=...] [PULLUP=ohm]: the last value of an analog pin (loaded by every analog sensor)."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

RATIO_MAX = 0.9999


class QueryADC:
    """The object `query_adc`."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.adc: dict[str, Any] = {}

    def register(self) -> None:
        """Make the command known."""
        self.printer.lookup_object("gcode").register_command(
            "QUERY_ADC", self.cmd_QUERY_ADC, desc="Report the last value of an analog pin"
        )

    def register_adc(self, name: str, mcu_adc: Any) -> None:
        """A pin by the name of the section that uses it."""
        self.adc[name] = mcu_adc

    def cmd_QUERY_ADC(self, gcmd: GCodeCommand) -> None:
        """A pin's value, or the names of all pins."""
        name = gcmd.get("NAME", None)
        if name not in self.adc:
            known = ", ".join(f'"{name}"' for name in sorted(self.adc))
            gcmd.respond_info(f"Available ADC objects: {known}")
            return
        value, timestamp = self.adc[name].get_last_value()
        text = f'ADC object "{name}" has value {value:.6f} (timestamp {timestamp:.3f})'
        pullup_ohm = gcmd.get_float("PULLUP", None, above=0.0)
        if pullup_ohm is not None:
            ratio = min(RATIO_MAX, max(1.0 - RATIO_MAX, value))
            ohm = pullup_ohm * ratio / (1.0 - ratio)
            text += f"\n resistance {ohm:.3f} (with {pullup_ohm:.0f} pullup)"
        gcmd.respond_info(text)


def register_adc(config: ConfigWrapper, name: str, mcu_adc: Any) -> None:
    """For a section with an analog pin."""
    config.get_printer().load_object(config, "query_adc").register_adc(name, mcu_adc)


def load_config(config: ConfigWrapper) -> QueryADC:
    """Loaded by analog sensors, or by section [query_adc]."""
    query = QueryADC(config.get_printer())
    query.register()
    return query
