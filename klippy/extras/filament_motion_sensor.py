"""[filament_motion_sensor NAME]: an encoder wheel that pulses while filament moves.

If the extruder has gone detection_length further since the last pulse, there is no filament (or it is stuck). What
happens then, and the other options: as in filament_switch_sensor.
"""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper

from .filament_switch_sensor import RunoutHelper

CHECK_PERIOD_S = 0.250


class EncoderSensor:
    """The object `filament_motion_sensor NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = printer = config.get_printer()
        self.reactor = printer.get_reactor()
        self.extruder_name = config.get("extruder")
        self.detection_length_mm = config.getfloat("detection_length", 7.0, above=0.0)
        buttons = printer.load_object(config, "buttons")
        self.runout_helper = RunoutHelper(config)
        self.get_status = self.runout_helper.get_status
        buttons.register_buttons([config.get("switch_pin")], self._on_pulse)
        self._extruder: Any = None
        self._mcu: Any = None
        self._runout_mm = 0.0  # extruder position at which the next pulse is overdue
        self._timer = self.reactor.register_timer(self._check)

    def register(self) -> None:
        """Start once the printer is ready; watch only while it prints."""
        for event, handler in (
            ("klippy:connect", self._handle_connect),
            ("klippy:ready", self._handle_ready),
            ("idle_timeout:printing", self._handle_printing),
            ("idle_timeout:ready", self._handle_not_printing),
            ("idle_timeout:idle", self._handle_not_printing),
        ):
            self.printer.register_event_handler(event, handler)

    def _handle_connect(self) -> None:
        self._extruder = self.printer.lookup_object(self.extruder_name, None)
        if self._extruder is None:
            raise self.printer.config_error(
                f"Filament motion sensor '{self.runout_helper.name}': there is no extruder '{self.extruder_name}'."
            )
        self._mcu = self.printer.lookup_object("mcu")

    def _position_mm(self, eventtime: float) -> float:
        position: float = self._extruder.find_past_position(self._mcu.estimated_print_time(eventtime))
        return position

    def _expect_pulse(self, eventtime: float) -> None:
        self._runout_mm = self._position_mm(eventtime) + self.detection_length_mm

    def _handle_ready(self) -> None:
        self._expect_pulse(self.reactor.monotonic())

    def _handle_printing(self, print_time: float) -> None:
        self.reactor.update_timer(self._timer, self.reactor.NOW)

    def _handle_not_printing(self, print_time: float) -> None:
        self.reactor.update_timer(self._timer, self.reactor.NEVER)

    def _check(self, eventtime: float) -> float:
        if self._position_mm(eventtime) >= self._runout_mm:
            self.runout_helper.note_filament_present(eventtime, False)
        return eventtime + CHECK_PERIOD_S

    def _on_pulse(self, eventtime: float, state: int) -> None:
        if self._extruder is None:
            return
        self._expect_pulse(eventtime)
        self.runout_helper.note_filament_present(eventtime, True)


def load_config_prefix(config: ConfigWrapper) -> EncoderSensor:
    """Section [filament_motion_sensor NAME]."""
    sensor = EncoderSensor(config)
    sensor.register()
    return sensor
