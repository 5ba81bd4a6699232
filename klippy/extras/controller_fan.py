"""[controller_fan NAME]: cools the electronics while a heater or a stepper driver works, and a while after."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper

from . import fan

_PERIOD_S = 1.0


@dataclass(frozen=True, slots=True)
class ControllerFanSettings:
    """Options of the section; speeds 0..1."""

    heater_names: tuple[str, ...]
    stepper_names: tuple[str, ...] | None  # None: every stepper
    fan_speed: float
    idle_speed: float
    idle_timeout_s: float


def read_settings(config: ConfigWrapper) -> ControllerFanSettings:
    fan_speed = config.getfloat("fan_speed", 1.0, minval=0.0, maxval=1.0)
    return ControllerFanSettings(
        config.getlist("heater", ("extruder",)),
        config.getlist("stepper", None),
        fan_speed,
        config.getfloat("idle_speed", fan_speed, minval=0.0, maxval=1.0),
        config.getint("idle_timeout", 30, minval=0),
    )


class ControllerFan:
    """The object `controller_fan NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.name = config.get_name()
        self.settings = read_settings(config)
        self.printer.load_object(config, "stepper_enable")
        self.printer.load_object(config, "heaters")
        self.fan = fan.Fan(config)
        self.get_status = self.fan.get_status
        self._heaters: list[Any] = []
        self._steppers: list[Any] = []
        self._active_until_s = float("-inf")
        self._last_speed = 0.0

    def register(self) -> None:
        """Look up the watched objects when all sections are loaded; start once the printer is ready."""
        self.printer.register_event_handler("klippy:connect", self._handle_connect)
        self.printer.register_event_handler("klippy:ready", self._handle_ready)

    def _handle_connect(self) -> None:
        heaters = self.printer.lookup_object("heaters")
        self._heaters = [heaters.lookup_heater(name) for name in self.settings.heater_names]
        enable = self.printer.lookup_object("stepper_enable")
        known = list(enable.get_steppers())
        wanted = known if self.settings.stepper_names is None else list(self.settings.stepper_names)
        for name in wanted:
            if name not in known:
                raise self.printer.config_error(
                    f"Section '{self.name}': stepper '{name}' is not known (there are: {', '.join(known)})."
                )
        self._steppers = [enable.lookup_enable(name) for name in wanted]

    def _handle_ready(self) -> None:
        self.reactor.register_timer(self._check, self.reactor.monotonic() + 0.1)

    def _is_active(self, eventtime: float) -> bool:
        heating = any(heater.get_temp(eventtime)[1] for heater in self._heaters)
        return heating or any(stepper.is_motor_enabled() for stepper in self._steppers)

    def _check(self, eventtime: float) -> float:
        settings = self.settings
        speed = 0.0
        if self._is_active(eventtime):
            self._active_until_s = eventtime
            speed = settings.fan_speed
        elif eventtime < self._active_until_s + settings.idle_timeout_s:
            speed = settings.idle_speed
        if speed != self._last_speed and not self.printer.is_shutdown():
            self._last_speed = speed
            self.fan.set_speed(speed)
        return eventtime + _PERIOD_S


def load_config_prefix(config: ConfigWrapper) -> ControllerFan:
    """Section [controller_fan NAME]."""
    controller_fan = ControllerFan(config)
    controller_fan.register()
    return controller_fan
