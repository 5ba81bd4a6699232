"""[temperature_fan NAME]: a fan that holds a temperature down.

    watermark  full speed above target + max_delta, off below target - max_delta
    pid        speed = max_power - (Kp e + Ki integral(e) - Kd de/dt) / 255, e = target - measured, at least min_speed

Without a target (0) the fan is off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

from configfile import ConfigWrapper
from gcode import GCodeCommand
from thermal.control import pid

from . import fan

KELVIN_0_C = -273.15
PWM_LEAD_S = 0.300  # from a reading to the speed it causes
RESEND_S = 2.0  # small changes wait this long
SMALL_CHANGE = 0.05


class CoolingLaw(Protocol):
    """Wanted speed 0..1 from a reading."""

    def decide(self, time_s: float, temp_c: float, target_c: float, low: float, high: float) -> float: ...


class WatermarkCooling:
    """On-off around the target."""

    def __init__(self, max_delta_c: float) -> None:
        self._max_delta_c = max_delta_c
        self._cooling = False

    def decide(self, time_s: float, temp_c: float, target_c: float, low: float, high: float) -> float:
        if temp_c >= target_c + self._max_delta_c:
            self._cooling = True
        elif temp_c <= target_c - self._max_delta_c:
            self._cooling = False
        return high if self._cooling else 0.0


class PidCooling:
    """The heaters' PID; its output is subtracted from full speed."""

    def __init__(self, parameters: pid.PidParameters) -> None:
        self._parameters = parameters
        self._state = pid.PidState()

    def decide(self, time_s: float, temp_c: float, target_c: float, low: float, high: float) -> float:
        # the law's output range is the room between full and minimum speed
        parameters = replace(self._parameters, output_low=0.0, output_high=max(high - low, 1e-6))
        inputs = pid.ControlInput(target_c, temp_c)
        output, self._state = pid.pid_step(parameters, self._state, inputs, time_s)
        return max(low, high - output.value)


def read_watermark(config: ConfigWrapper) -> CoolingLaw:
    return WatermarkCooling(config.getfloat("max_delta", 2.0, above=0.0))


def read_pid(config: ConfigWrapper) -> CoolingLaw:
    gains = [config.getfloat("pid_Kp", above=0.0)]
    gains += [config.getfloat(option, minval=0.0) for option in ("pid_Ki", "pid_Kd")]
    deriv_time_s = config.getfloat("pid_deriv_time", 2.0, above=0.0)
    return PidCooling(pid.klipper_pid(gains[0], gains[1], gains[2], 1.0, deriv_time_s))


LAWS: dict[str, Callable[[Any], CoolingLaw]] = {"watermark": read_watermark, "pid": read_pid}


@dataclass(slots=True)
class Limits:
    """What SET_TEMPERATURE_FAN_TARGET changes."""

    target_c: float
    min_speed: float
    max_speed: float


class TemperatureFan:
    """The object `temperature_fan NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.name = config.get_name().split(maxsplit=1)[1]
        self.printer = config.get_printer()
        self.fan = fan.Fan(config, default_shutdown_speed=1.0)
        self.min_temp = config.getfloat("min_temp", minval=KELVIN_0_C)
        self.max_temp = config.getfloat("max_temp", above=self.min_temp)
        self.limits = Limits(
            config.getfloat(
                "target_temp", min(40.0, self.max_temp), minval=self.min_temp, maxval=self.max_temp
            ),
            config.getfloat("min_speed", 0.3, minval=0.0, maxval=1.0),
            config.getfloat("max_speed", 1.0, above=0.0, maxval=1.0),
        )
        self.configured_target_c = self.limits.target_c
        self.law = LAWS[config.getchoice("control", {name: name for name in LAWS})](config)
        heaters = self.printer.load_object(config, "heaters")
        self.sensor = heaters.setup_sensor(config)
        self.sensor.setup_minmax(self.min_temp, self.max_temp)
        self.sensor.setup_callback(self._on_reading)
        heaters.register_sensor(config, self)
        self.last_temp = 0.0
        self._speed = 0.0
        self._resend_s = 0.0

    def register(self) -> None:
        """Make the command known."""
        self.printer.lookup_object("gcode").register_mux_command(
            "SET_TEMPERATURE_FAN_TARGET",
            "TEMPERATURE_FAN",
            self.name,
            self.cmd_SET_TEMPERATURE_FAN_TARGET,
            desc="Sets a temperature fan target and fan speed limits",
        )

    def _on_reading(self, read_time: float, temp_c: float) -> None:
        self.last_temp = temp_c
        limits = self.limits
        speed = self.law.decide(read_time, temp_c, limits.target_c, limits.min_speed, limits.max_speed)
        if limits.target_c <= 0.0:
            speed = 0.0
        change = abs(speed - self._speed)
        if not change or (change < SMALL_CHANGE and speed and self._speed and read_time < self._resend_s):
            return
        self._resend_s = read_time + RESEND_S
        self._speed = speed
        self.fan.set_speed(speed, read_time + PWM_LEAD_S + self.sensor.get_report_time_delta())

    def get_temp(self, eventtime: float) -> tuple[float, float]:
        return self.last_temp, self.limits.target_c

    def get_status(self, eventtime: float) -> dict[str, Any]:
        status = self.fan.get_status(eventtime)
        status["temperature"] = round(self.last_temp, 2)
        status["target"] = self.limits.target_c
        return status

    def set_temp(self, degrees: float) -> None:
        """New target in degC, 0 = off. Raises the printer's command_error if out of range."""
        if degrees and not self.min_temp <= degrees <= self.max_temp:
            raise self.printer.command_error(
                f"Requested temperature ({degrees:.1f}) out of range ({self.min_temp:.1f}:{self.max_temp:.1f})"
            )
        self.limits.target_c = degrees

    def cmd_SET_TEMPERATURE_FAN_TARGET(self, gcmd: GCodeCommand) -> None:
        """TARGET, MIN_SPEED, MAX_SPEED; without TARGET the one of the config."""
        low = gcmd.get_float("MIN_SPEED", self.limits.min_speed, minval=0.0, maxval=1.0)
        high = gcmd.get_float("MAX_SPEED", self.limits.max_speed, above=0.0, maxval=1.0)
        if low > high:
            raise gcmd.error(f"Requested min speed ({low:.1f}) is greater than max speed ({high:.1f})")
        self.set_temp(gcmd.get_float("TARGET", self.configured_target_c))
        self.limits.min_speed, self.limits.max_speed = low, high


def load_config_prefix(config: ConfigWrapper) -> TemperatureFan:
    """Section [temperature_fan NAME]."""
    temperature_fan = TemperatureFan(config)
    temperature_fan.register()
    return temperature_fan
