"""[hall_filament_width_sensor]: two Hall sensors on opposite sides of the filament; their sum is its width.

The sum is linear in the diameter between two rods that were measured (cal_dia1, raw_dia1; cal_dia2, raw_dia2). What
happens without filament, and the options of that, are those of [filament_switch_sensor].
"""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .filament_switch_sensor import RunoutHelper
from .filament_width.compensation import WidthCompensation, setup_adc

RAW_FULL_SCALE = 10000  # a raw value of one sensor


class HallWidthSensor:
    """The object `hall_filament_width_sensor`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self._raw = [0, 0]
        for number, option in enumerate(("adc1", "adc2")):
            setup_adc(config, option, self._taker(number))
        self._rods = [
            (config.getint(f"raw_dia{n}", raw), config.getfloat(f"cal_dia{n}", diameter_mm, above=0.0))
            for n, raw, diameter_mm in ((1, 9500, 1.5), (2, 10500, 2.0))
        ]
        if self._rods[0][0] == self._rods[1][0]:
            raise config.error(
                f"Options 'raw_dia1' and 'raw_dia2' in section '{config.get_name()}' ({config.where('raw_dia2')}) are"
                f" both {self._rods[0][0]}: they must differ, as the two rods do."
            )
        self.width = WidthCompensation(
            config,
            self.diameter_mm,
            float(config.getint("measurement_interval", 10, minval=1)),
            config.getboolean("enable", False),
            config.getboolean("enable_flow_compensation", True),
            config.getboolean("use_current_dia_while_delay", False),
        )
        self.width.is_logging = config.getboolean("logging", False)
        self._min_mm = config.getfloat("min_diameter", 1.0, minval=0.0)
        widest_mm = self.width.nominal_mm + self.width.max_difference_mm
        self._max_mm = config.getfloat("max_diameter", widest_mm, above=self._min_mm)
        self.runout_helper = RunoutHelper(config)

    def register(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        for command, text in (
            ("QUERY_RAW_FILAMENT_WIDTH", "Return the raw value of the filament width sensor"),
            ("ENABLE_FILAMENT_WIDTH_LOG", "Report each measured width"),
            ("DISABLE_FILAMENT_WIDTH_LOG", "Do not report each measured width"),
            ("ENABLE_FILAMENT_WIDTH_COMPENSATION", "Let the flow follow the filament's width"),
            ("DISABLE_FILAMENT_WIDTH_COMPENSATION", "Measure only, the flow does not follow"),
            ("QUERY_FILAMENT_WIDTH_COMPENSATION", "Return whether the flow follows the filament's width"),
        ):
            gcode.register_command(command, getattr(self, f"cmd_{command}"), desc=text)

    def _taker(self, number: int) -> Any:
        def take(print_time: float, value: float) -> None:
            self._raw[number] = round(value * RAW_FULL_SCALE)
            if number and self.width.enabled:
                present = self._min_mm < self.diameter_mm() < self._max_mm
                eventtime = self.printer.get_reactor().monotonic()
                self.runout_helper.note_filament_present(eventtime, present)

        return take

    def diameter_mm(self) -> float:
        (raw1, mm1), (raw2, mm2) = self._rods
        return max(0.0, mm1 + (sum(self._raw) - raw1) * (mm2 - mm1) / (raw2 - raw1))

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {
            **self.runout_helper.get_status(eventtime),
            "Diameter": round(self.diameter_mm(), 4),
            "Raw": sum(self._raw),
            "is_active": self.width.enabled,
        }

    def cmd_QUERY_RAW_FILAMENT_WIDTH(self, gcmd: GCodeCommand) -> None:
        """For the calibration with two rods."""
        first, second = self._raw
        gcmd.respond_info(f"ADC1={first} ADC2={second} RAW={first + second}")

    def cmd_ENABLE_FILAMENT_WIDTH_LOG(self, gcmd: GCodeCommand) -> None:
        """To the console and the log, at each interval."""
        self.width.is_logging = True
        gcmd.respond_info("Filament width logging Turned On")

    def cmd_DISABLE_FILAMENT_WIDTH_LOG(self, gcmd: GCodeCommand) -> None:
        """Measure silently."""
        self.width.is_logging = False
        gcmd.respond_info("Filament width logging Turned Off")

    def cmd_ENABLE_FILAMENT_WIDTH_COMPENSATION(self, gcmd: GCodeCommand) -> None:
        """The flow follows."""
        self.width.set_corrects(True)
        self.cmd_QUERY_FILAMENT_WIDTH_COMPENSATION(gcmd)

    def cmd_DISABLE_FILAMENT_WIDTH_COMPENSATION(self, gcmd: GCodeCommand) -> None:
        """A runout sensor only."""
        self.width.set_corrects(False)
        self.cmd_QUERY_FILAMENT_WIDTH_COMPENSATION(gcmd)

    def cmd_QUERY_FILAMENT_WIDTH_COMPENSATION(self, gcmd: GCodeCommand) -> None:
        """Does the flow follow?"""
        gcmd.respond_info(
            f"Filament width compensation is {'enabled' if self.width.corrects else 'disabled'}"
        )


def load_config(config: ConfigWrapper) -> HallWidthSensor:
    sensor = HallWidthSensor(config)
    sensor.register()
    return sensor
