"""[servo NAME]: a hobby servo, SET_SERVO SERVO=NAME ANGLE=… or WIDTH=… (pulse width in s, 0: no signal)."""

from __future__ import annotations

from dataclasses import dataclass

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .outputs.scheduled_pin import ScheduledPin

SERVO_PERIOD_S = 0.020  # the rhythm servos expect


@dataclass(frozen=True, slots=True)
class ServoSettings:
    """Options of the section."""

    min_width_s: float
    max_width_s: float
    max_angle: float

    def width_of(self, angle: float) -> float:
        """Pulse width of an angle, which is limited to 0..max_angle."""
        share = min(1.0, max(0.0, angle / self.max_angle))
        return self.min_width_s + share * (self.max_width_s - self.min_width_s)

    def limit(self, width_s: float) -> float:
        """A pulse width within the range; 0 stays 0."""
        return min(self.max_width_s, max(self.min_width_s, width_s)) if width_s else 0.0


def read_settings(config: ConfigWrapper) -> ServoSettings:
    min_width_s = config.getfloat("minimum_pulse_width", 0.001, above=0.0, below=SERVO_PERIOD_S)
    return ServoSettings(
        min_width_s,
        config.getfloat("maximum_pulse_width", 0.002, above=min_width_s, below=SERVO_PERIOD_S),
        config.getfloat("maximum_servo_angle", 180.0, above=0.0),
    )


class PrinterServo:
    """The object `servo NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.settings = settings = read_settings(config)
        self.mcu_servo = self.printer.lookup_object("pins").setup_pin("pwm", config.get("pin"))
        self.mcu_servo.setup_max_duration(0.0)
        self.mcu_servo.setup_cycle_time(SERVO_PERIOD_S)
        angle = config.getfloat("initial_angle", None, minval=0.0, maxval=settings.max_angle)
        if angle is None:
            width_s = config.getfloat("initial_pulse_width", 0.0, minval=0.0, maxval=settings.max_width_s)
            initial = settings.limit(width_s) / SERVO_PERIOD_S
        else:
            initial = settings.width_of(angle) / SERVO_PERIOD_S
        self.last_value = initial
        self.mcu_servo.setup_start_value(initial, 0.0)
        self._output = ScheduledPin(self.printer, self.mcu_servo.get_mcu(), self.mcu_servo.set_pwm, initial)

    def register(self, name: str) -> None:
        """Make the command known."""
        self.printer.lookup_object("gcode").register_mux_command(
            "SET_SERVO", "SERVO", name, self.cmd_SET_SERVO, desc="Set servo angle"
        )

    @property
    def max_angle(self) -> float:
        """maximum_servo_angle."""
        return self.settings.max_angle

    def _get_pwm_from_angle(self, angle: float) -> float:
        """Duty cycle; this and the next two are names that plugins call."""
        return self.settings.width_of(angle) / SERVO_PERIOD_S

    def _get_pwm_from_pulse_width(self, width_s: float) -> float:
        return self.settings.limit(width_s) / SERVO_PERIOD_S

    def _set_pwm(self, print_time: float, value: float) -> None:
        self.last_value = value
        self._output.request(print_time, value)

    def get_status(self, eventtime: float) -> dict[str, float]:
        """Duty cycle of the pin."""
        return {"value": self.last_value}

    def cmd_SET_SERVO(self, gcmd: GCodeCommand) -> None:
        """Move it, in step with the moves queued so far."""
        width_s = gcmd.get_float("WIDTH", None)
        if width_s is None:
            width_s = self.settings.width_of(gcmd.get_float("ANGLE"))
        self.last_value = self.settings.limit(width_s) / SERVO_PERIOD_S
        self._output.queue_from_command(self.last_value)


def load_config_prefix(config: ConfigWrapper) -> PrinterServo:
    """Section [servo NAME]."""
    servo = PrinterServo(config)
    servo.register(config.get_name().split(maxsplit=1)[1])
    return servo
