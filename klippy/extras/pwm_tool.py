"""[pwm_tool NAME]: a PWM pin for a laser or a spindle. SET_PIN values follow each other as fast as the moves."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper

from .output_pin import PrinterOutputPin
from .outputs.scheduled_pin import QueuedPin

WAITING = 32  # values on the board ahead of their time: some hundred a second with 0.1 s on the way


class PrinterPwmTool(PrinterOutputPin):
    """The object `pwm_tool NAME`."""

    output_class = QueuedPin

    def _read_is_pwm(self, config: ConfigWrapper) -> bool:
        return True

    def _make_pin(self, config: ConfigWrapper) -> Any:
        pin = super()._make_pin(config)
        setup_waiting = getattr(pin, "setup_waiting", None)
        if setup_waiting is None:
            raise config.error(
                f"Option 'pin' in section '{config.get_name()}': a tool needs a pin of a board itself"
                f" ({config.where('pin')})."
            )
        setup_waiting(WAITING)
        return pin


def load_config_prefix(config: ConfigWrapper) -> PrinterPwmTool:
    """Section [pwm_tool NAME]."""
    tool = PrinterPwmTool(config)
    tool.register(config.get_name().split(maxsplit=1)[1])
    return tool
