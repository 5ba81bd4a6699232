"""Heaters and temperature sensors as the rest of the printer knows them.

`PrinterHeaters` (object "heaters") is the registry: sensor types by name, heaters by name, M105 ids, and the
commands that address any heater. Ordinary heaters are ordinary.py's, or onoff.py's where the MCU
switches by itself. The induction nozzle brings its own (`induction_heater.py`) and registers here under the name of
the extruder it serves; everything that speaks to heaters uses only the `AnyHeater` role below.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

from configfile import ConfigWrapper
from gcode import GCodeCommand
from link import optional_board
from roles import Printer

from .heater import onoff as heater_onoff
from .heater.laws import read_law
from .heater.ordinary import MAX_HEAT_TIME_S, AnySensor, Heater, is_batch, range_error, read_settings
from .sensors import types as sensor_types

__all__ = ["AnyHeater", "AnySensor", "Heater", "PrinterHeaters", "is_batch", "load_config", "range_error"]

WAIT_POLL_S = 1.0
# What is tuned by command: loaded with the first heater.
TUNING = ("pid_calibrate", "model_calibrate", "heater_profile")


class AnyHeater(Protocol):
    """What the printer asks of any heater."""

    name: str

    def set_temp(self, degrees: float) -> None: ...
    def get_temp(self, eventtime: float) -> tuple[float, float]: ...
    def check_busy(self, eventtime: float) -> bool: ...
    def get_status(self, eventtime: float) -> dict[str, Any]: ...
    def stats(self, eventtime: float) -> tuple[bool, str]: ...


SensorFactory = Callable[[Any], AnySensor]


def build_heater(config: ConfigWrapper, sensor: AnySensor) -> Heater:
    """Heater of a section with heater_pin; loads its verify_heater watch."""
    printer = config.get_printer()
    for option in ("heater_pin", "sensor_pin"):
        optional_board.refuse(config, option)
    settings = read_settings(config)
    law = read_law(config, settings.max_power, settings.smooth_time_s)
    if law.name == "mcu_onoff":
        return finish_heater(config, heater_onoff.build(config, settings, sensor, law))
    pwm = printer.lookup_object("pins").setup_pin("pwm", config.get("heater_pin"))
    pwm.setup_cycle_time(settings.pwm_cycle_s)
    pwm.setup_max_duration(MAX_HEAT_TIME_S)
    return finish_heater(config, Heater(printer, settings, sensor, law, pwm))


def finish_heater(config: ConfigWrapper, heater: Heater) -> Heater:
    """Its watch, and what flows through it."""
    config.get_printer().load_object(config, f"verify_heater {heater.name}")
    if config.get_name().startswith("extruder"):
        diameter_mm = config.getfloat("filament_diameter", 1.75, above=0.0, note_valid=False)
        heater.melts(math.pi * 0.25 * diameter_mm**2)
    return heater


class PrinterHeaters:
    """Sensor types, heaters and the commands that address any of them."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.sensor_factories: dict[str, SensorFactory] = {}
        self.heaters: dict[str, AnyHeater] = {}
        self._other_names: dict[str, AnyHeater] = {}
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

    def setup_sensor(self, config: ConfigWrapper) -> AnySensor:
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

    def _load_builtin(self, config: ConfigWrapper) -> None:
        """Built-in types, then the sections that define custom ones, in any order of the config."""
        if not self._builtin_loaded:
            self._builtin_loaded = True
            sensor_types.register_builtin(self)
        for module in sensor_types.CUSTOM_SECTIONS:
            for section in config.get_prefix_sections(f"{module} "):
                self.printer.load_object(config, section.get_name())

    def setup_heater(self, config: ConfigWrapper, gcode_id: str | None = None) -> Any:
        """The heater of a section: an ordinary one, or the one its option `heater` names."""
        section_name = config.get_name()
        name = section_name.split()[-1]
        if name in self.heaters:
            raise config.error(f"Heater {name} already registered")
        served = config.get("heater", None)
        if served is not None:
            heater = self.printer.load_object(config, f"induction_heater {served}").serve(config)
            self._other_names[served] = heater
        else:
            heater = build_heater(config, self.setup_sensor(config))
        self.add_heater(config, heater, gcode_id)
        return heater

    def add_heater(self, config: ConfigWrapper, heater: Any, gcode_id: str | None = None) -> None:
        """Make a finished heater known under its section."""
        section_name = config.get_name()
        self.heaters[heater.name] = heater
        self.available_heaters.append(section_name)
        self.register_sensor(config, heater, gcode_id)
        self.answer_to(heater.name, heater)

    def answer_to(self, name: str | None, heater: AnyHeater) -> None:
        """SET_HEATER_TEMPERATURE HEATER=name is for this heater; None: also without HEATER."""

        def set_heater_temperature(gcmd: GCodeCommand) -> None:
            self.set_temperature(heater, gcmd.get_float("TARGET", 0.0))

        self.printer.lookup_object("gcode").register_mux_command(
            "SET_HEATER_TEMPERATURE",
            "HEATER",
            name,
            set_heater_temperature,
            desc="Sets a heater temperature",
        )

    def register_sensor(self, config: ConfigWrapper, psensor: Any, gcode_id: str | None = None) -> None:
        """A sensor (or heater) for status listings, and for M105 if it has an id there."""
        self.available_sensors.append(config.get_name())
        if gcode_id is None:
            gcode_id = config.get("gcode_id", None)
            if gcode_id is None:
                return
        if gcode_id in self.gcode_id_to_sensor:
            raise config.error(f"G-Code sensor id {gcode_id} already registered")
        self.gcode_id_to_sensor[gcode_id] = psensor

    def register_monitor(self, config: ConfigWrapper) -> None:
        """A section that only watches temperatures."""
        self.available_monitors.append(config.get_name())

    def lookup_heater(self, heater_name: str) -> Any:
        """Heater by short name, or by that of its own section; raises the printer's config_error."""
        heater = self.heaters.get(heater_name) or self._other_names.get(heater_name)
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
            self._wait_while(
                heater.check_busy, f"{heater.name} to reach {temp:.1f} C", lambda: heater.set_temp(temp)
            )

    def _wait_while(
        self, is_busy: Callable[[float], bool], what: str, begin_anew: Callable[[], None]
    ) -> None:
        """Report the temperatures once a second, until done or shut down; after a pause, begin anew."""
        if is_batch(self.printer):
            return
        toolhead = self.printer.lookup_object("toolhead")
        gcode = self.printer.lookup_object("gcode")
        reactor = self.printer.get_reactor()
        eventtime = reactor.monotonic()
        while not self.printer.is_shutdown() and is_busy(eventtime):
            toolhead.get_last_move_time()  # keeps the print time running while nothing moves
            gcode.respond_raw(self._report(eventtime))
            if gcode.waits.sleep(eventtime + WAIT_POLL_S, what):
                begin_anew()
            eventtime = reactor.monotonic()

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
        if len(self.heaters) == 1:
            (only,) = self.heaters.values()
            self.answer_to(None, only)

    def _on_restart(self, print_time: float) -> None:
        self.turn_off_all_heaters()

    def cmd_M105(self, gcmd: GCodeCommand) -> None:
        line = self._report(self.printer.get_reactor().monotonic())
        if not gcmd.ack(line):
            gcmd.respond_raw(line)

    def cmd_TURN_OFF_HEATERS(self, gcmd: GCodeCommand) -> None:
        self.turn_off_all_heaters()

    def cmd_TEMPERATURE_WAIT(self, gcmd: GCodeCommand) -> None:
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

        target_c = sensor.get_temp(self.printer.get_reactor().monotonic())[1] if name in self.heaters else 0.0

        def heat_again() -> None:
            if name in self.heaters and not sensor.get_temp(self.printer.get_reactor().monotonic())[1]:
                sensor.set_temp(target_c)  # a macro PAUSE switched it off

        self._wait_while(outside, f"{name} ({minimum_c:g} to {maximum_c:g} C)", heat_again)


def load_config(config: ConfigWrapper) -> PrinterHeaters:
    heaters = PrinterHeaters(config.get_printer())
    heaters.register()
    for module in TUNING:
        config.get_printer().load_object(config, module)
    return heaters
