"""The flow factor follows the filament's width."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .delay import WidthQueue

SAMPLE_S, SAMPLES, REPORT_S = 0.001, 8, 0.5
CHECK_S = 0.5


class WidthCompensation:
    """A sensor of the filament's width. `read()` gives the diameter at the sensor now, mm; 0: not known yet."""

    def __init__(
        self, config: ConfigWrapper, read: Callable[[], float], interval_mm: float, enabled: bool, corrects: bool,
        use_current: bool = False,
    ) -> None:  # fmt: skip
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.gcode = self.printer.lookup_object("gcode")
        self.nominal_mm = config.getfloat("default_nominal_filament_diameter", above=1.0)
        self.max_difference_mm = config.getfloat("max_difference", 0.2, above=0.0, below=self.nominal_mm)
        self._queue = WidthQueue(config.getfloat("measurement_delay", above=0.0), interval_mm)
        self._read = read
        self._use_current = use_current
        self._has_melted = False  # a measured diameter has reached the melt
        self.enabled, self.corrects = enabled, corrects
        self.is_logging = False
        self._percent = 100
        self._timer = self.reactor.register_timer(self._check)
        self.printer.register_event_handler("klippy:ready", self._start)
        for command, text in (
            ("QUERY_FILAMENT_WIDTH", "Return the filament's width"),
            ("RESET_FILAMENT_WIDTH_SENSOR", "Clear all readings of the filament's width"),
            ("ENABLE_FILAMENT_WIDTH_SENSOR", "Let the flow follow the filament's width"),
            ("DISABLE_FILAMENT_WIDTH_SENSOR", "Do not let the flow follow the filament's width"),
        ):
            self.gcode.register_command(command, getattr(self, f"cmd_{command}"), desc=text)

    def _start(self) -> None:
        self.reactor.update_timer(self._timer, self.reactor.NOW if self.enabled else self.reactor.NEVER)

    def _check(self, eventtime: float) -> float:
        """Timer."""
        toolhead = self.printer.lookup_object("toolhead")
        print_time = self.printer.lookup_object("mcu").estimated_print_time(eventtime)
        diameter_mm = self._read()
        if diameter_mm <= 0.0:
            return eventtime + CHECK_S
        mean = self._queue.measure(toolhead.get_extruder().find_past_position(print_time), diameter_mm)
        if mean is not None and self.is_logging:
            self.gcode.respond_info(f"Filament width: {mean:.3f} mm")
            logging.info("Filament width: %.3f mm", mean)
        # the factor is for moves that are yet to come, not for those under way
        melting = self._queue.melting(toolhead.get_position()[3])
        if melting is None and self._use_current and not self._has_melted:
            self._set_flow(diameter_mm)
        elif melting is not None:
            self._has_melted = True
            self._set_flow(melting)
        return eventtime + CHECK_S

    def _set_flow(self, diameter_mm: float) -> None:
        if not self.corrects:
            return
        near = abs(diameter_mm - self.nominal_mm) <= self.max_difference_mm
        self._set_percent(round(100.0 * (self.nominal_mm / diameter_mm) ** 2) if near else 100)

    def _set_percent(self, percent: int) -> None:
        if percent != self._percent:
            self._percent = percent
            self.reactor.register_callback(lambda eventtime: self.gcode.run_script(f"M221 S{percent}"))

    def reset(self) -> None:
        self._queue.clear()
        self._has_melted = False
        self._set_percent(100)

    def set_corrects(self, corrects: bool) -> None:
        """Whether the flow follows."""
        self.corrects = corrects
        if not corrects:
            self._set_percent(100)

    def cmd_QUERY_FILAMENT_WIDTH(self, gcmd: GCodeCommand) -> None:
        """The diameter now."""
        gcmd.respond_info(f"Filament dia (measured mm): {self._read():.3f}")

    def cmd_RESET_FILAMENT_WIDTH_SENSOR(self, gcmd: GCodeCommand) -> None:
        """The filament is another one."""
        self.reset()
        gcmd.respond_info("Filament width measurements cleared")

    def cmd_ENABLE_FILAMENT_WIDTH_SENSOR(self, gcmd: GCodeCommand) -> None:
        """Measure, and correct."""
        text = "is already enabled" if self.enabled else "Turned On"
        self.enabled = True
        self._start()
        gcmd.respond_info(f"Filament width sensor {text}")

    def cmd_DISABLE_FILAMENT_WIDTH_SENSOR(self, gcmd: GCodeCommand) -> None:
        """Stop measuring; the flow is as the G-code says."""
        text = "Turned Off" if self.enabled else "is already disabled"
        self.enabled = False
        self._start()
        self.reset()
        gcmd.respond_info(f"Filament width sensor {text}")


def setup_adc(config: ConfigWrapper, option: str, callback: Callable[[float, float], None]) -> Any:
    """The analog input of an option; `callback(print_time, share of full scale)` twice a second."""
    printer = config.get_printer()
    adc = printer.lookup_object("pins").setup_pin("adc", config.get(option))
    adc.setup_adc_sample(SAMPLE_S, SAMPLES)
    adc.setup_adc_callback(REPORT_S, callback)
    printer.load_object(config, "query_adc").register_adc(f"{config.get_name()}:{option}", adc)
    return adc
