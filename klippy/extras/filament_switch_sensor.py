"""[filament_switch_sensor NAME]: a switch that knows whether there is filament; `RunoutHelper` for other sensors.

    runout while printing   PAUSE (pause_on_runout), then runout_gcode
    insert while not        insert_gcode
    QUERY_FILAMENT_SENSOR SENSOR=…, SET_FILAMENT_SENSOR SENSOR=… ENABLE=0|1

Events closer than event_delay to the end of the one before are ignored, and so is everything in the first seconds.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

START_DELAY_S = 2.0  # after ready: the switches report their state first


@dataclass(frozen=True, slots=True)
class RunoutSettings:
    """Options every filament sensor has."""

    pause_on_runout: bool
    event_delay_s: float
    pause_delay_s: float


class RunoutHelper:
    """What happens when filament comes and goes."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.name = config.get_name().split()[-1]
        self.printer = printer = config.get_printer()
        self.reactor = printer.get_reactor()
        self.gcode = printer.lookup_object("gcode")
        self.settings = RunoutSettings(
            config.getboolean("pause_on_runout", True),
            config.getfloat("event_delay", 3.0, minval=0.0),
            config.getfloat("pause_delay", 0.5, minval=0.0),
        )
        if self.settings.pause_on_runout:
            printer.load_object(config, "pause_resume")
        self.runout_gcode = self._template(config, "runout_gcode")
        self.insert_gcode = self._template(config, "insert_gcode")
        self.filament_present = False
        self.sensor_enabled = True
        self._not_before_s = float("inf")
        printer.register_event_handler("klippy:ready", self._handle_ready)
        for command, handler, text in (
            (
                "QUERY_FILAMENT_SENSOR",
                self.cmd_QUERY_FILAMENT_SENSOR,
                "Query the status of the Filament Sensor",
            ),
            ("SET_FILAMENT_SENSOR", self.cmd_SET_FILAMENT_SENSOR, "Sets the filament sensor on/off"),
        ):
            self.gcode.register_mux_command(command, "SENSOR", self.name, handler, desc=text)

    def _template(self, config: ConfigWrapper, option: str) -> Any:
        """The option's template; without one of runout, pausing alone needs an empty one."""
        if config.get(option, None) is None:
            needed = option == "runout_gcode" and self.settings.pause_on_runout
            if not needed:
                return None
        return self.printer.load_object(config, "gcode_macro").load_template(config, option, "")

    def _handle_ready(self) -> None:
        self._not_before_s = self.reactor.monotonic() + START_DELAY_S

    def note_filament_present(self, eventtime: float, is_filament_present: bool) -> None:
        """The sensor's new state, at most as often as it changes."""
        if is_filament_present == self.filament_present:
            return
        self.filament_present = is_filament_present
        if eventtime < self._not_before_s or not self.sensor_enabled:
            return
        idle_timeout = self.printer.lookup_object("idle_timeout")
        is_printing = idle_timeout.get_status(eventtime)["state"] == "Printing"
        handler = None
        if is_filament_present and not is_printing and self.insert_gcode is not None:
            handler = self._insert
        elif not is_filament_present and is_printing and self.runout_gcode is not None:
            handler = self._runout
        if handler is not None:
            self._not_before_s = float("inf")  # until the handler is through
            logging.info("Filament sensor %s: %s at %.2f", self.name, handler.__name__.lstrip("_"), eventtime)
            self.reactor.register_callback(handler)

    def _runout(self, eventtime: float) -> None:
        prefix = ""
        if self.settings.pause_on_runout:
            self.printer.lookup_object("pause_resume").send_pause_command()
            prefix = "PAUSE\n"
            self.reactor.pause(eventtime + self.settings.pause_delay_s)
        self._run(prefix, self.runout_gcode)

    def _insert(self, eventtime: float) -> None:
        self._run("", self.insert_gcode)

    def _run(self, prefix: str, template: Any) -> None:
        try:
            self.gcode.run_script(f"{prefix}{template.render()}\nM400")
        except self.printer.command_error as e:
            self.gcode.respond_error(f"Filament sensor '{self.name}': {e}")
        self._not_before_s = self.reactor.monotonic() + self.settings.event_delay_s

    def get_status(self, eventtime: float) -> dict[str, bool]:
        return {"filament_detected": bool(self.filament_present), "enabled": bool(self.sensor_enabled)}

    def cmd_QUERY_FILAMENT_SENSOR(self, gcmd: GCodeCommand) -> None:
        """Say whether there is filament."""
        state = "filament detected" if self.filament_present else "filament not detected"
        gcmd.respond_info(f"Filament Sensor {self.name}: {state}")

    def cmd_SET_FILAMENT_SENSOR(self, gcmd: GCodeCommand) -> None:
        """Switch the sensor on or off."""
        self.sensor_enabled = bool(gcmd.get_int("ENABLE", 1))


class SwitchSensor:
    """The object `filament_switch_sensor NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        buttons = config.get_printer().load_object(config, "buttons")
        self.runout_helper = RunoutHelper(config)
        self.get_status = self.runout_helper.get_status
        buttons.register_buttons([config.get("switch_pin")], self._on_switch)

    def _on_switch(self, eventtime: float, state: int) -> None:
        self.runout_helper.note_filament_present(eventtime, bool(state))


def load_config_prefix(config: ConfigWrapper) -> SwitchSensor:
    """Section [filament_switch_sensor NAME]."""
    return SwitchSensor(config)
