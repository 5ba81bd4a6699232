"""[fan]: the print cooling fan (M106, M107), and `Fan` for other fans."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from link import optional_board

from . import pulse_counter
from .outputs.scheduled_pin import ScheduledPin

_PIN_MIN_TIME_S = 0.1  # how far ahead of the MCU's clock a change outside the move queue is placed
_CHANGES_MAX = 64  # more than M106 in the moves of some seconds
_KICK_RISE = 0.5  # a rise of speed beyond this is kicked even if the fan turns already


@dataclass(frozen=True, slots=True)
class FanSettings:
    """Options of a fan; speeds and powers are shares of full power."""

    max_power: float
    kick_start_time_s: float
    off_below: float
    cycle_time_s: float
    hardware_pwm: bool
    shutdown_speed: float


def read_settings(config: ConfigWrapper, default_shutdown_speed: float) -> FanSettings:
    """The options every fan has."""
    return FanSettings(
        max_power=config.getfloat("max_power", 1.0, above=0.0, maxval=1.0),
        kick_start_time_s=config.getfloat("kick_start_time", 0.1, minval=0.0),
        off_below=config.getfloat("off_below", 0.0, minval=0.0, maxval=1.0),
        cycle_time_s=config.getfloat("cycle_time", 0.010, above=0.0),
        hardware_pwm=config.getboolean("hardware_pwm", False),
        shutdown_speed=config.getfloat("shutdown_speed", default_shutdown_speed, minval=0.0, maxval=1.0),
    )


class Fan:
    """A fan on a PWM pin, with an optional tachometer."""

    def __init__(self, config: ConfigWrapper, default_shutdown_speed: float = 0.0) -> None:
        self.printer = config.get_printer()
        self.settings = read_settings(config, default_shutdown_speed)
        self.last_fan_value = 0.0
        self.changes: deque[tuple[float, float]] = deque(maxlen=_CHANGES_MAX)  # newest (print time, speed)
        pins = self.printer.lookup_object("pins")
        self.mcu_fan = pins.setup_pin("pwm", config.get("pin"))
        self.mcu_fan.setup_max_duration(0.0)
        self.mcu_fan.setup_cycle_time(self.settings.cycle_time_s, self.settings.hardware_pwm)
        self.mcu_fan.setup_start_value(0.0, self._power(self.settings.shutdown_speed))
        enable_pin = config.get("enable_pin", None)
        self.enable_pin = None
        if enable_pin is not None:
            self.enable_pin = pins.setup_pin("digital_out", enable_pin)
            self.enable_pin.setup_max_duration(0.0)
        self.tachometer = pulse_counter.tachometer_from_config(config)
        self._output = ScheduledPin(self.printer, self.mcu_fan.get_mcu(), self._apply, 0.0)
        self.printer.register_event_handler("gcode:request_restart", self._handle_request_restart)

    def get_mcu(self) -> Any:
        """The MCU of the pin."""
        return self.mcu_fan.get_mcu()

    def _power(self, speed: float) -> float:
        speed = min(1.0, max(0.0, speed))
        return 0.0 if speed < self.settings.off_below else speed * self.settings.max_power

    def _apply(self, print_time: float, power: float) -> None:
        if self.enable_pin is not None:
            self.enable_pin.set_digital(print_time, power > 0.0)
        self.mcu_fan.set_pwm(print_time, power)

    def _schedule(self, print_time: float, speed: float) -> None:
        power = self._power(speed)
        before = self.last_fan_value
        if power == before:
            return
        self.last_fan_value = power
        self.changes.append((print_time, power))
        starts = before == 0.0 or power - before > _KICK_RISE * self.settings.max_power
        kick_s = self.settings.kick_start_time_s
        if power and kick_s and power < self.settings.max_power and starts:
            self._output.request(print_time, self.settings.max_power)
            print_time += kick_s
        self._output.request(print_time, power)

    def set_speed(self, value: float, print_time: float | None = None) -> None:
        """Set the speed (0..1) at `print_time`, by default as soon as possible."""
        if print_time is None:
            now = self.printer.get_reactor().monotonic()
            print_time = self.get_mcu().estimated_print_time(now) + _PIN_MIN_TIME_S
        self._schedule(print_time, value)

    def set_speed_from_command(self, value: float) -> None:
        """Set the speed in step with the moves queued so far."""
        optional_board.require_connected(self.get_mcu())
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.register_lookahead_callback(lambda print_time: self._schedule(print_time, value))

    def _handle_request_restart(self, print_time: float) -> None:
        self.set_speed(0.0, print_time)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """Speed 0..1 as requested (share of full power); rpm is None without tachometer."""
        rpm = self.tachometer.get_status(eventtime)["rpm"] if self.tachometer is not None else None
        return {"speed": self.last_fan_value, "rpm": rpm}


class PrinterFan:
    """The object `fan`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.fan = Fan(config)
        self.get_status = self.fan.get_status
        gcode = config.get_printer().lookup_object("gcode")
        gcode.register_command("M106", self.cmd_M106)
        gcode.register_command("M107", self.cmd_M107)

    def cmd_M106(self, gcmd: GCodeCommand) -> None:
        """Set the speed, S0..255."""
        self.fan.set_speed_from_command(gcmd.get_float("S", 255.0, minval=0.0) / 255.0)

    def cmd_M107(self, gcmd: GCodeCommand) -> None:
        """Off."""
        self.fan.set_speed_from_command(0.0)


def load_config(config: ConfigWrapper) -> PrinterFan:
    """Section [fan]."""
    return PrinterFan(config)
