"""Heaters and temperature sensors as the rest of the printer knows them.

`PrinterHeaters` (object "heaters") is the registry: sensor types by name, heaters by name, M105 ids, and the
commands that address any heater. `Heater` is the ordinary one: an ADC sensor in, a PWM pin out, a control law
of `thermal/control.py` between. The induction nozzle brings its own heater (`induction_heater.py`) and
registers here under the name of the extruder it serves; everything that speaks to heaters uses only the
`AnyHeater` role below.

Time line of an ordinary heater, once per sensor report (0.3 s):

    sample ── report ── control law ── PWM set for sample + PWM_DELAY_S  (fixed delay, no jitter)

Safety without the host: the pin's max_duration turns it off MAX_HEAT_TIME_S after the last command.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

from thermal import control

from . import sensor_types

PWM_DELAY_S = 0.300  # from sample to PWM change; at least one report interval, so it is always in the future
MAX_HEAT_TIME_S = 3.0  # the MCU turns the pin off after this long without a command
PWM_HOLD_S = 2.0  # small PWM changes are held back this long, well inside MAX_HEAT_TIME_S
PWM_HOLD_DELTA = 0.05  # "small"
QUELL_STALE_S = 5.0  # a reading older than this no longer counts as the temperature
AMBIENT_C = 25.0  # starting point of the smoothed value before the first reading
WAIT_POLL_S = 1.0

PID_BUSY_C = 1.0  # M109 returns when this near to the target ...
PID_BUSY_SLOPE_C_S = 0.1  # ... and changing slower than this


class AnyHeater(Protocol):
    """What the printer asks of any heater."""

    name: str

    def set_temp(self, degrees: float) -> None: ...
    def get_temp(self, eventtime: float) -> tuple[float, float]: ...
    def check_busy(self, eventtime: float) -> bool: ...
    def get_status(self, eventtime: float) -> dict[str, Any]: ...
    def stats(self, eventtime: float) -> tuple[bool, str]: ...


class AnySensor(Protocol):
    """What a temperature sensor offers its heater."""

    def setup_minmax(self, min_temp: float, max_temp: float) -> None: ...
    def setup_callback(self, temperature_callback: Callable[[float, float], None]) -> None: ...
    def get_report_time_delta(self) -> float: ...


SensorFactory = Callable[[Any], AnySensor]


def range_error(degrees: float, min_temp: float, max_temp: float) -> str:
    """Text for a target outside the heater's range."""
    return f"Requested temperature ({degrees:.1f}) out of range ({min_temp:.1f}:{max_temp:.1f})"


######################################################################
# Control laws of ordinary heaters
######################################################################


class ControlLaw(Protocol):
    """One heater's control law with its memory; duty is PWM 0..1."""

    def decide(self, time_s: float, temp_c: float, target_c: float) -> float: ...
    def is_busy(self, smoothed_c: float, target_c: float) -> bool: ...


class PidLaw:
    """PID with Klipper's documented gains (duty = (Kp e + Ki integral - Kd slope) / 255)."""

    def __init__(self, parameters: control.PidParameters) -> None:
        self.parameters = parameters
        self.state = control.PidState()

    def decide(self, time_s: float, temp_c: float, target_c: float) -> float:
        if target_c <= 0.0:
            self.state = replace(self.state, integral=0.0)
        inputs = control.ControlInput(target_c, temp_c)
        output, self.state = control.pid_step(self.parameters, self.state, inputs, time_s)
        return output.value if target_c > 0.0 else 0.0

    def is_busy(self, smoothed_c: float, target_c: float) -> bool:
        slope = abs(self.state.slope_c_s)
        return abs(target_c - smoothed_c) > PID_BUSY_C or slope > PID_BUSY_SLOPE_C_S


class WatermarkLaw:
    """On-off control around the target."""

    def __init__(self, parameters: control.WatermarkParameters) -> None:
        self.parameters = parameters
        self.state = control.WatermarkState()

    def decide(self, time_s: float, temp_c: float, target_c: float) -> float:
        if target_c <= 0.0:
            self.state = control.WatermarkState()
            return 0.0
        inputs = control.ControlInput(target_c, temp_c)
        output, self.state = control.watermark_step(self.parameters, self.state, inputs, time_s)
        return output.value

    def is_busy(self, smoothed_c: float, target_c: float) -> bool:
        return smoothed_c < target_c - self.parameters.max_delta_c


def read_pid_law(config: Any, max_power: float, smooth_time_s: float) -> ControlLaw:
    """`control: pid` of an ordinary heater."""
    pid_kp = config.getfloat("pid_Kp", above=0.0)
    pid_ki, pid_kd = (config.getfloat(option, minval=0.0) for option in ("pid_Ki", "pid_Kd"))
    return PidLaw(control.klipper_pid(pid_kp, pid_ki, pid_kd, max_power, smooth_time_s))


def read_watermark_law(config: Any, max_power: float, smooth_time_s: float) -> ControlLaw:
    """`control: watermark`; smoothing plays no part."""
    max_delta_c = config.getfloat("max_delta", 2.0, above=0.0)
    return WatermarkLaw(control.WatermarkParameters(max_delta_c, max_power))


CONTROL_LAWS: dict[str, Callable[[Any, float, float], ControlLaw]] = {
    "pid": read_pid_law,
    "watermark": read_watermark_law,
}


######################################################################
# The ordinary heater
######################################################################


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


def read_settings(config: Any) -> HeaterSettings:
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
        self, printer: Any, settings: HeaterSettings, sensor: AnySensor, law: ControlLaw, pwm: Any
    ) -> None:
        self.printer = printer
        self.settings = settings
        self.name = settings.name.split()[-1]
        self.sensor = sensor
        self.law = law
        self.pwm = pwm
        self.min_temp = settings.min_temp_c
        self.max_temp = settings.max_temp_c
        self.can_extrude = settings.min_extrude_c <= 0.0 or is_batch(printer)
        self._target_c = 0.0
        self._temp_c = 0.0
        self._smoothed_c = 0.0
        self._read_s = 0.0  # print time of the newest reading
        self._duty = 0.0
        self._duty_due_s = 0.0  # print time from which an unchanged duty is repeated
        self._stopped = False
        sensor.setup_minmax(settings.min_temp_c, settings.max_temp_c)
        sensor.setup_callback(self._on_reading)
        printer.register_event_handler("klippy:shutdown", self._on_shutdown)

    # The control path, once per sensor report

    def _on_reading(self, read_time_s: float, temp_c: float) -> None:
        since_s = read_time_s - self._read_s
        self._temp_c = temp_c
        self._read_s = read_time_s
        target_c = 0.0 if self._stopped else self._target_c
        duty = self.law.decide(read_time_s, temp_c, target_c)
        self._apply(read_time_s, duty, target_c)
        share = min(1.0, since_s / self.settings.smooth_time_s)
        self._smoothed_c += (temp_c - self._smoothed_c) * share
        self.can_extrude = self._smoothed_c >= self.settings.min_extrude_c or is_batch(self.printer)

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

    # The outward interface

    def set_temp(self, degrees: float) -> None:
        """New target in degC, 0 = off. Raises the printer's command_error if out of range."""
        if degrees and not self.min_temp <= degrees <= self.max_temp:
            raise self.printer.command_error(range_error(degrees, self.min_temp, self.max_temp))
        self._target_c = degrees

    def alter_target(self, target_temp: float) -> None:
        """Move the target without an error, limited to the range; 0 stays off."""
        if target_temp:
            target_temp = max(self.min_temp, min(self.max_temp, target_temp))
        self._target_c = target_temp

    def get_temp(self, eventtime: float) -> tuple[float, float]:
        """(smoothed temperature, target) in degC; (0, target) if readings have stopped."""
        now_s = self.pwm.get_mcu().estimated_print_time(eventtime)
        if self._read_s < now_s - QUELL_STALE_S:
            return 0.0, self._target_c
        return self._smoothed_c, self._target_c

    def check_busy(self, eventtime: float) -> bool:
        """Still on the way to the target?"""
        return self.law.is_busy(self._smoothed_c, self._target_c)

    def set_control(self, law: ControlLaw) -> ControlLaw:
        """Swap the control law, target off; returns the one before."""
        before, self.law = self.law, law
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
            "target": self._target_c,
            "power": self._duty,
        }

    def stats(self, eventtime: float) -> tuple[bool, str]:
        active = self._target_c > 0.0 or self._temp_c > 50.0
        return (
            active,
            f"{self.name}: target={self._target_c:.0f} temp={self._temp_c:.1f} pwm={self._duty:.3f}",
        )


def build_heater(config: Any, sensor: AnySensor) -> Heater:
    """Heater of a section with heater_pin; loads its verify_heater watch."""
    printer = config.get_printer()
    settings = read_settings(config)
    law_name = config.getchoice("control", {name: name for name in CONTROL_LAWS})
    law = CONTROL_LAWS[law_name](config, settings.max_power, settings.smooth_time_s)
    pwm = printer.lookup_object("pins").setup_pin("pwm", config.get("heater_pin"))
    pwm.setup_cycle_time(settings.pwm_cycle_s)
    pwm.setup_max_duration(MAX_HEAT_TIME_S)
    heater = Heater(printer, settings, sensor, law, pwm)
    printer.load_object(config, f"verify_heater {heater.name}")
    return heater


def is_batch(printer: Any) -> bool:
    """Writing commands to a file, with nothing to measure.

    Waits return at once, cold extrusion is allowed.
    """
    return printer.get_start_args().get("debugoutput") is not None


######################################################################
# The registry
######################################################################


class PrinterHeaters:
    """Sensor types, heaters and the commands that address any of them."""

    def __init__(self, printer: Any) -> None:
        self.printer = printer
        self.sensor_factories: dict[str, SensorFactory] = {}
        self.heaters: dict[str, AnyHeater] = {}
        self.gcode_id_to_sensor: dict[str, Any] = {}
        self.available_heaters: list[str] = []
        self.available_sensors: list[str] = []
        self.available_monitors: list[str] = []
        self._has_started = False
        self._builtin_loaded = False

    def register(self) -> None:
        """Events and commands."""
        printer = self.printer
        printer.register_event_handler("klippy:ready", self._on_ready)
        printer.register_event_handler("gcode:request_restart", self._on_restart)
        gcode = printer.lookup_object("gcode")
        gcode.register_command("TURN_OFF_HEATERS", self.cmd_TURN_OFF_HEATERS, desc="Turn off all heaters")
        gcode.register_command("M105", self.cmd_M105, when_not_ready=True)
        gcode.register_command(
            "TEMPERATURE_WAIT", self.cmd_TEMPERATURE_WAIT, desc="Wait for a temperature on a sensor"
        )

    # Registration

    def add_sensor_factory(self, sensor_type: str, sensor_factory: SensorFactory) -> None:
        """A sensor type by the name used in `sensor_type:`."""
        self.sensor_factories[sensor_type] = sensor_factory

    def register_sensor_factory(self, sensor_type: str, sensor_factory: SensorFactory) -> None:
        """The same under the other name in use."""
        self.add_sensor_factory(sensor_type, sensor_factory)

    def setup_sensor(self, config: Any) -> AnySensor:
        """Sensor object of a section's `sensor_type`."""
        self._load_builtin(config)
        sensor_type = config.get("sensor_type")
        factory = self.sensor_factories.get(sensor_type)
        if factory is None:
            raise config.error(
                f"Unknown temperature sensor '{sensor_type}' in section '{config.get_name()}'; known are: "
                + ", ".join(sorted(self.sensor_factories))
            )
        return factory(config)

    def _load_builtin(self, config: Any) -> None:
        """Built-in types, then the sections that define custom ones, wherever they stand."""
        if self._builtin_loaded:
            return
        self._builtin_loaded = True
        sensor_types.register_builtin(self)
        for module in sensor_types.CUSTOM_SECTIONS:
            for section in config.get_prefix_sections(f"{module} "):
                self.printer.load_object(config, section.get_name())

    def setup_heater(self, config: Any, gcode_id: str | None = None) -> Any:
        """The heater of a section: an ordinary one, or the one its option `heater` names."""
        section_name = config.get_name()
        name = section_name.split()[-1]
        if name in self.heaters:
            raise config.error(f"Heater {name} already registered")
        served = config.get("heater", None)
        if served is not None:
            heater = self.printer.load_object(config, f"induction_heater {served}").serve(config)
        else:
            heater = build_heater(config, self.setup_sensor(config))
        self.add_heater(config, heater, gcode_id)
        return heater

    def add_heater(self, config: Any, heater: Any, gcode_id: str | None = None) -> None:
        """Make a finished heater known under its section."""
        section_name = config.get_name()
        self.heaters[heater.name] = heater
        self.available_heaters.append(section_name)
        self.register_sensor(config, heater, gcode_id)

        def set_heater_temperature(gcmd: Any) -> None:
            self.set_temperature(heater, gcmd.get_float("TARGET", 0.0))

        self.printer.lookup_object("gcode").register_mux_command(
            "SET_HEATER_TEMPERATURE",
            "HEATER",
            heater.name,
            set_heater_temperature,
            desc="Sets a heater temperature",
        )

    def register_sensor(self, config: Any, psensor: Any, gcode_id: str | None = None) -> None:
        """A sensor (or heater) for status listings, and for M105 if it has an id there."""
        self.available_sensors.append(config.get_name())
        if gcode_id is None:
            gcode_id = config.get("gcode_id", None)
            if gcode_id is None:
                return
        if gcode_id in self.gcode_id_to_sensor:
            raise config.error(f"G-Code sensor id {gcode_id} already registered")
        self.gcode_id_to_sensor[gcode_id] = psensor

    def register_monitor(self, config: Any) -> None:
        """A section that only watches temperatures."""
        self.available_monitors.append(config.get_name())

    def lookup_heater(self, heater_name: str) -> Any:
        """Heater by short name; raises the printer's config_error."""
        heater = self.heaters.get(heater_name)
        if heater is None:
            known = ", ".join(sorted(self.heaters)) or "none"
            raise self.printer.config_error(f"Unknown heater '{heater_name}' (known: {known})")
        return heater

    def get_all_heaters(self) -> list[str]:
        return list(self.available_heaters)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {
            "available_heaters": self.available_heaters,
            "available_sensors": self.available_sensors,
            "available_monitors": self.available_monitors,
        }

    # Doing

    def turn_off_all_heaters(self, print_time: float = 0.0) -> None:
        for heater in self.heaters.values():
            heater.set_temp(0.0)

    def set_temperature(self, heater: AnyHeater, temp: float, wait: bool = False) -> None:
        """Set a target, in step with the moves planned so far, and wait for it if asked."""
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.register_lookahead_callback(lambda print_time: None)
        heater.set_temp(temp)
        if wait and temp:
            self._wait_while(heater.check_busy)

    def _wait_while(self, is_busy: Callable[[float], bool]) -> None:
        """Poll once a second, telling the temperatures, until done or shut down."""
        if is_batch(self.printer):
            return
        toolhead = self.printer.lookup_object("toolhead")
        gcode = self.printer.lookup_object("gcode")
        reactor = self.printer.get_reactor()
        eventtime = reactor.monotonic()
        while not self.printer.is_shutdown() and is_busy(eventtime):
            toolhead.get_last_move_time()  # keeps the print time running while nothing moves
            gcode.respond_raw(self._report(eventtime))
            eventtime = reactor.pause(eventtime + WAIT_POLL_S)

    def _report(self, eventtime: float) -> str:
        """The M105 line."""
        if not self._has_started:
            return "T:0"
        parts = []
        for gcode_id, sensor in sorted(self.gcode_id_to_sensor.items()):
            temp_c, target_c = sensor.get_temp(eventtime)
            parts.append(f"{gcode_id}:{temp_c:.1f} /{target_c:.1f}")
        return " ".join(parts) if parts else "T:0"

    def _on_ready(self) -> None:
        self._has_started = True

    def _on_restart(self, print_time: float) -> None:
        self.turn_off_all_heaters()

    def cmd_M105(self, gcmd: Any) -> None:
        line = self._report(self.printer.get_reactor().monotonic())
        if not gcmd.ack(line):
            gcmd.respond_raw(line)

    def cmd_TURN_OFF_HEATERS(self, gcmd: Any) -> None:
        self.turn_off_all_heaters()

    def cmd_TEMPERATURE_WAIT(self, gcmd: Any) -> None:
        name = gcmd.get("SENSOR")
        if name not in self.available_sensors:
            known = ", ".join(self.available_sensors)
            raise gcmd.error(f"Unknown sensor '{name}' (known: {known})")
        minimum_c = gcmd.get_float("MINIMUM", float("-inf"))
        maximum_c = gcmd.get_float("MAXIMUM", float("inf"), above=minimum_c)
        if minimum_c == float("-inf") and maximum_c == float("inf"):
            raise gcmd.error("TEMPERATURE_WAIT needs MINIMUM or MAXIMUM")
        sensor = self.heaters.get(name) or self.printer.lookup_object(name)

        def outside(eventtime: float) -> bool:
            temp_c = sensor.get_temp(eventtime)[0]
            return not minimum_c <= temp_c <= maximum_c

        self._wait_while(outside)


def load_config(config: Any) -> PrinterHeaters:
    heaters = PrinterHeaters(config.get_printer())
    heaters.register()
    return heaters
