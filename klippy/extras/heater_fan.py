"""[heater_fan NAME]: a fan that runs while a heater is on or hot."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper

from . import fan

_PERIOD_S = 1.0


class PrinterHeaterFan:
    """Switches between `fan_speed` and off once a second."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.printer.load_object(config, "heaters", None)
        self.heater_names = config.getlist("heater", ("extruder",))
        self.heater_temp_c = config.getfloat("heater_temp", 50.0)
        self.fan_speed = config.getfloat("fan_speed", 1.0, minval=0.0, maxval=1.0)
        self.fan = fan.Fan(config, default_shutdown_speed=1.0)
        self.get_status = self.fan.get_status
        self._heaters: list[Any] = []
        self.last_speed = 0.0

    def register(self) -> None:
        """Start once the printer is ready."""
        self.printer.register_event_handler("klippy:ready", self._handle_ready)

    def _handle_ready(self) -> None:
        heaters = self.printer.lookup_object("heaters")
        self._heaters = [heaters.lookup_heater(name) for name in self.heater_names]
        self.reactor.register_timer(self._check, self.reactor.monotonic() + 0.1)

    def _check(self, eventtime: float) -> float:
        wanted = False
        for heater in self._heaters:
            temp_c, target_c = heater.get_temp(eventtime)
            wanted = wanted or bool(target_c) or temp_c > self.heater_temp_c
        speed = self.fan_speed if wanted else 0.0
        if speed != self.last_speed and not self.printer.is_shutdown():
            self.last_speed = speed
            self.fan.set_speed(speed)
        return eventtime + _PERIOD_S


def load_config_prefix(config: ConfigWrapper) -> PrinterHeaterFan:
    """Section [heater_fan NAME]."""
    heater_fan = PrinterHeaterFan(config)
    heater_fan.register()
    return heater_fan
