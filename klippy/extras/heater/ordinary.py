"""The ordinary heater: an ADC sensor in, a PWM pin out, a control law of `laws.py` between.

Once per sensor report (0.3 s):

    sample ── report ── control law ── PWM set for sample + PWM_DELAY_S  (fixed delay, no jitter)

In calibration (`acquire` until `release`) an identification run decides in the law's place. Safety without the host:
the pin's max_duration turns it off MAX_HEAT_TIME_S after the last command.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from configfile import ConfigWrapper
from roles import Printer
from thermal.identification.run import OutputRun

from .laws import HeaterLaw, Surroundings

PWM_DELAY_S = 0.300  # from sample to PWM change; at least one report interval, so it is always in the future
MAX_HEAT_TIME_S = 3.0  # the MCU turns the pin off after this long without a command
PWM_HOLD_S = 2.0  # small PWM changes are held back this long, well inside MAX_HEAT_TIME_S
PWM_HOLD_DELTA = 0.05  # "small"
QUELL_STALE_S = 5.0  # a reading older than this no longer counts as the temperature


class AnySensor(Protocol):
    """What a temperature sensor offers its heater."""

    def setup_minmax(self, min_temp: float, max_temp: float) -> None: ...
    def setup_callback(self, temperature_callback: Callable[[float, float], None]) -> None: ...
    def get_report_time_delta(self) -> float: ...


def range_error(degrees: float, min_temp: float, max_temp: float) -> str:
    """Text for a target outside the heater's range."""
    return f"Requested temperature ({degrees:.1f}) out of range ({min_temp:.1f}:{max_temp:.1f})"


def is_batch(printer: Printer) -> bool:
    """Writing commands to a file, with nothing to measure.

    Waits return at once, cold extrusion is allowed.
    """
    return printer.get_start_args().get("debugoutput") is not None


@dataclass(frozen=True, slots=True)
class HeaterSettings:
    """Plain values of one heater section."""

    name: str  # full section name
    min_temp_c: float
    max_temp_c: float
    max_power: float  # duty 0..1
    smooth_time_s: float
    min_extrude_c: float
    pwm_cycle_s: float


def read_settings(config: ConfigWrapper) -> HeaterSettings:
    """HeaterSettings of a section; raises the config's error on a missing or wrong option."""
    min_temp_c = config.getfloat("min_temp", minval=-273.15)
    max_temp_c = config.getfloat("max_temp", above=min_temp_c)
    return HeaterSettings(
        config.get_name(),
        min_temp_c,
        max_temp_c,
        config.getfloat("max_power", 1.0, above=0.0, maxval=1.0),
        config.getfloat("smooth_time", 1.0, above=0.0),
        config.getfloat("min_extrude_temp", 170.0, minval=min_temp_c, maxval=max_temp_c),
        config.getfloat("pwm_cycle_time", 0.100, above=0.0, maxval=0.3),
    )


class Heater:
    """An ordinary heater: sensor reports in, PWM out."""

    def __init__(
        self, printer: Printer, settings: HeaterSettings, sensor: AnySensor, law: HeaterLaw, pwm: Any
    ) -> None:
        self.printer = printer
        self.settings = settings
        self.name = settings.name.split()[-1]
        self.sensor = sensor
        self.law = law
        self.pwm = pwm
        self.min_temp = settings.min_temp_c
        self.max_temp = settings.max_temp_c
        self.min_extrude_temp = settings.min_extrude_c
        self.can_extrude = settings.min_extrude_c <= 0.0 or is_batch(printer)
        self._target_c = 0.0
        self._temp_c = 0.0
        self._smoothed_c = 0.0
        self._read_s = 0.0  # print time of the newest reading
        self._duty = 0.0
        self._duty_due_s = 0.0  # print time from which an unchanged duty is repeated
        self._stopped = False
        self._run: OutputRun | None = None
        law.surroundings = self._surroundings
        self._filament_mm2 = 0.0
        sensor.setup_minmax(settings.min_temp_c, settings.max_temp_c)
        sensor.setup_callback(self._on_reading)
        printer.register_event_handler("klippy:shutdown", self._on_shutdown)

    # The control path, once per sensor report

    def _on_reading(self, read_time_s: float, temp_c: float) -> None:
        since_s = read_time_s - self._read_s
        self._temp_c = temp_c
        self._read_s = read_time_s
        self._act(read_time_s, temp_c, 0.0 if self._stopped else self._target_c)
        share = min(1.0, since_s / self.settings.smooth_time_s)
        self._smoothed_c += (temp_c - self._smoothed_c) * share
        self.can_extrude = self._smoothed_c >= self.settings.min_extrude_c or is_batch(self.printer)

    def _act(self, read_time_s: float, temp_c: float, target_c: float) -> None:
        """The law's decision to the pin, or that of a calibration."""
        duty = self.law.decide(read_time_s, temp_c, target_c)
        if self._run is not None:
            duty = 0.0 if self._stopped else self._run.decide(read_time_s, temp_c, self.settings.max_power)
            target_c = duty
        self._apply(read_time_s, duty, target_c)

    def _surroundings(self) -> Surroundings:
        """Part fan and flow, for a heater that melts filament."""
        if not self._filament_mm2:
            return Surroundings()
        eventtime = self.printer.get_reactor().monotonic()
        fan = self.printer.lookup_object("fan", None)
        motion = self.printer.lookup_object("motion_report", None)
        speed = motion.get_status(eventtime)["live_extruder_velocity"] if motion is not None else 0.0
        share = fan.get_status(eventtime)["speed"] if fan is not None else 0.0
        return Surroundings(max(0.0, speed) * self._filament_mm2, share)

    def melts(self, filament_mm2: float) -> None:
        """Filament of this cross section goes through: fan and flow are part of the model."""
        self._filament_mm2 = filament_mm2

    def _apply(self, read_time_s: float, duty: float, target_c: float) -> None:
        """Send the duty, unless the pin nearly does it already and need not be reminded yet."""
        if target_c <= 0.0:
            duty = 0.0
        small = abs(duty - self._duty) < PWM_HOLD_DELTA and (duty > 0.0) == (self._duty > 0.0)
        if small and (read_time_s < self._duty_due_s or not duty):
            return
        at_s = read_time_s + PWM_DELAY_S + self.sensor.get_report_time_delta()
        self._duty_due_s = read_time_s + PWM_HOLD_S
        self._duty = duty
        self.pwm.set_pwm(at_s, duty)

    def _on_shutdown(self) -> None:
        self._stopped = True
        if self._run is not None:
            self._run.abort("the printer stopped")

    # In calibration

    def acquire(self, run: OutputRun) -> None:
        """Let `run` decide the duty; raises command_error if the heater is in use."""
        if self._target_c or self.in_calibration:
            raise self.printer.command_error(f"Turn heater '{self.name}' off before calibrating it")
        self._run = run

    def release(self) -> None:
        """The law decides again, heater off: after the run's last duty and before the next report's. The MCU gets an
        update no sooner than the time of the one before; two for the same time would come too late."""
        self._run = None
        self._target_c = 0.0
        self._apply(self._read_s + 0.5 * self.sensor.get_report_time_delta(), 0.0, 0.0)

    @property
    def in_calibration(self) -> bool:
        return self._run is not None

    @property
    def output_max(self) -> float:
        """Duty."""
        return self.settings.max_power

    def reading(self, eventtime: float) -> tuple[float, float]:
        """(age in s, degC) of the newest reading, not smoothed."""
        if not self._read_s:
            return math.inf, math.nan
        return self.pwm.get_mcu().estimated_print_time(eventtime) - self._read_s, self._temp_c

    # The outward interface

    def set_temp(self, degrees: float) -> None:
        """New target in degC, 0 = off. Raises the printer's command_error if out of range."""
        if self._run is not None:
            if degrees:
                raise self.printer.command_error(f"Heater '{self.name}' is being calibrated; ABORT ends that")
            self._run.abort("the heater was turned off")
        if degrees and not self.min_temp <= degrees <= self.max_temp:
            raise self.printer.command_error(range_error(degrees, self.min_temp, self.max_temp))
        self._target_c = degrees

    def alter_target(self, target_temp: float) -> None:
        """Move the target without an error, limited to the range; 0 stays off."""
        if target_temp:
            target_temp = max(self.min_temp, min(self.max_temp, target_temp))
        self.set_temp(target_temp)

    def get_temp(self, eventtime: float) -> tuple[float, float]:
        """(smoothed temperature, target) in degC; (0, target) if readings have stopped."""
        now_s = self.pwm.get_mcu().estimated_print_time(eventtime)
        if self._read_s < now_s - QUELL_STALE_S:
            return 0.0, self.target_temp
        return self._smoothed_c, self.target_temp

    @property
    def target_temp(self) -> float:
        """The target for verify_heater and the status: a calibration's while one runs."""
        return self._target_c if self._run is None else self._run.target_c

    def check_busy(self, eventtime: float) -> bool:
        """Still on the way to the target?"""
        return self.law.is_busy(self._smoothed_c, self._target_c)

    def set_control(self, law: HeaterLaw, keep_target: bool = False) -> HeaterLaw:
        """Swap the control law, target off or kept without a bump; returns the one before."""
        before, self.law = self.law, law
        law.surroundings = self._surroundings
        if keep_target:
            law.take_over(before, self._temp_c, self._target_c, self._duty)
        else:
            self._target_c = 0.0
        return before

    def set_pwm(self, read_time: float, value: float) -> None:
        """Drive the pin from outside the control law (calibration); obeys shutdown and target."""
        self._apply(read_time, value, 0.0 if self._stopped else self._target_c)

    def get_pwm_delay(self) -> float:
        """Seconds from a sensor report to the PWM change it causes."""
        return PWM_DELAY_S + self.sensor.get_report_time_delta()

    def get_max_power(self) -> float:
        return self.settings.max_power

    def get_smooth_time(self) -> float:
        return self.settings.smooth_time_s

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {
            "temperature": round(self._smoothed_c, 2),
            "target": self.target_temp,
            "power": self._duty,
        }

    def stats(self, eventtime: float) -> tuple[bool, str]:
        active = self._target_c > 0.0 or self._temp_c > 50.0
        return (
            active,
            f"{self.name}: target={self._target_c:.0f} temp={self._temp_c:.1f} pwm={self._duty:.3f}",
        )
