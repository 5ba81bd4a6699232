"""[output_pin NAME]: a pin set by SET_PIN, digital or PWM."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .outputs.scheduled_pin import ScheduledPin

_MAX_KEEP_ALIVE_S = 5.0


class GCodeRequestQueue(ScheduledPin):
    """Values for a plugin's pin, in order of time: callback(print_time, value)."""

    def __init__(self, config: ConfigWrapper, mcu: Any, callback: Callable[[float, float], Any]) -> None:
        super().__init__(config.get_printer(), mcu, callback, math.nan)

    def queue_gcode_request(self, value: float) -> None:
        self.queue_from_command(value)

    def send_async_request(self, value: float, print_time: float | None = None) -> None:
        if print_time is None:
            self.set_now(value)
        else:
            self.request(print_time, value)


class PrinterOutputPin:
    """The object `output_pin NAME`. Values are in units of `scale` outwards, 0..1 inside."""

    output_class = ScheduledPin

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.is_pwm = self._read_is_pwm(config)
        self.scale = config.getfloat("scale", 1.0, above=0.0) if self.is_pwm else 1.0
        self.pin = self._make_pin(config)
        max_duration_s = config.getfloat("maximum_mcu_duration", 0.0, minval=0.5, maxval=_MAX_KEEP_ALIVE_S)
        self.pin.setup_max_duration(max_duration_s)
        start = config.getfloat("value", 0.0, minval=0.0, maxval=self.scale) / self.scale
        shutdown = config.getfloat("shutdown_value", 0.0, minval=0.0, maxval=self.scale) / self.scale
        self.pin.setup_start_value(start, shutdown)
        self.last_value = start
        self._output = self.output_class(self.printer, self.pin.get_mcu(), self._apply, start)
        self._output.keep_alive(max_duration_s, shutdown)
        self._templates = self.printer.load_object(config, "template_evaluator")

    def _read_is_pwm(self, config: ConfigWrapper) -> bool:
        return bool(config.getboolean("pwm", False))

    def _make_pin(self, config: ConfigWrapper) -> Any:
        pins = self.printer.lookup_object("pins")
        if not self.is_pwm:
            return pins.setup_pin("digital_out", config.get("pin"))
        pin = pins.setup_pin("pwm", config.get("pin"))
        cycle_time_s = config.getfloat("cycle_time", 0.100, above=0.0, maxval=_MAX_KEEP_ALIVE_S)
        pin.setup_cycle_time(cycle_time_s, config.getboolean("hardware_pwm", False))
        return pin

    def register(self, name: str) -> None:
        """Make the command known."""
        self.printer.lookup_object("gcode").register_mux_command(
            "SET_PIN", "PIN", name, self.cmd_SET_PIN, desc="Set the value of an output pin"
        )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """The value 0..1."""
        return {"value": self.last_value}

    def _apply(self, print_time: float, value: float) -> None:
        if self.is_pwm:
            self.pin.set_pwm(print_time, value)
        else:
            self.pin.set_digital(print_time, int(value))

    def cmd_SET_PIN(self, gcmd: GCodeCommand) -> None:
        """Set the value in step with the moves queued so far."""
        if gcmd.get("TEMPLATE", None) is not None:
            self._templates.assign(self, gcmd, self._show)
            return
        self._templates.forget(self)
        value = gcmd.get_float("VALUE", minval=0.0, maxval=self.scale) / self.scale
        if not self.is_pwm and value not in (0.0, 1.0):
            raise gcmd.error("Invalid pin value: a digital pin is 0 or 1")
        self.last_value = value
        self._output.queue_from_command(value)

    def _show(self, text: str) -> None:
        """The value a template gives, now; a digital pin is on from a half."""
        value = min(1.0, max(0.0, float(text) / self.scale))
        self.last_value = value if self.is_pwm else float(value >= 0.5)
        self._output.set_now(self.last_value)


def load_config_prefix(config: ConfigWrapper) -> PrinterOutputPin:
    """Section [output_pin NAME]."""
    pin = PrinterOutputPin(config)
    pin.register(config.get_name().split(maxsplit=1)[1])
    return pin
