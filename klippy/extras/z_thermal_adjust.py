"""[z_thermal_adjust]: the frame grows with its temperature; z is corrected by temp_coeff mm for each degree.

The reference is the temperature at the last homing of z. The correction is part of every move; while the head rests it
stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .probing.smoothed import SmoothedSensor

UNLIMITED_MM = 99999999.0
_Z = 2


class ZThermalAdjust:
    """Printer object 'z_thermal_adjust'; a transform between G-code and toolhead."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.sensor = SmoothedSensor(config)
        self.temp_coeff = config.getfloat("temp_coeff", 0.0, minval=-1.0, maxval=1.0)
        self._off_above_mm = config.getfloat("z_adjust_off_above", UNLIMITED_MM)
        self._max_mm = config.getfloat("max_z_adjustment", UNLIMITED_MM, minval=0.0)
        self.is_enabled = True
        self.adjust_mm = 0.0
        self._reference_c: float | None = None
        self._reference_overridden = False
        self.next_transform: Any = None
        self.printer.register_event_handler("klippy:connect", self._handle_connect)
        self.printer.register_event_handler("homing:home_rails_end", self._handle_homed)
        self.printer.lookup_object("gcode").register_command(
            "SET_Z_THERMAL_ADJUST",
            self.cmd_SET_Z_THERMAL_ADJUST,
            desc="Set/query Z Thermal Adjust parameters.",
        )

    def _handle_connect(self) -> None:
        gcode_move = self.printer.lookup_object("gcode_move")
        self.next_transform = gcode_move.set_move_transform(self, force=True)

    def _handle_homed(self, homing_state: Any, rails: Any) -> None:
        """What was corrected before is in the place of the endstop now."""
        if _Z in homing_state.get_axes():
            self._reference_c = self.sensor.temp_c
            self._reference_overridden = False
            self.adjust_mm = 0.0
            self.printer.lookup_object("gcode_move").reset_last_position()

    @property
    def passes_to(self) -> Any:
        """Who gets every move unchanged."""
        return None if self.temp_coeff or self.adjust_mm else self.next_transform

    def row_stage(self) -> None:
        """Each move is corrected by the temperature of its moment."""
        return

    def get_position(self) -> list[float]:
        x, y, z, *further = self.next_transform.get_position()
        return [x, y, z - self.adjust_mm, *further]

    def move(self, newpos: Sequence[float], speed: float) -> None:
        x, y, z, *further = newpos
        if self.is_enabled and self._reference_c is not None and z <= self._off_above_mm:
            adjust_mm = -self.temp_coeff * (self.sensor.temp_c - self._reference_c)
            self.adjust_mm = max(-self._max_mm, min(self._max_mm, adjust_mm))
        self.next_transform.move([x, y, z + self.adjust_mm, *further], speed)

    def cmd_SET_Z_THERMAL_ADJUST(self, gcmd: GCodeCommand) -> None:
        """SET_Z_THERMAL_ADJUST [ENABLE=0|1] [TEMP_COEFF=mm/°C] [REF_TEMP=°C]."""
        is_enabled = gcmd.get_int("ENABLE", int(self.is_enabled), minval=0, maxval=1)
        coeff = gcmd.get_float("TEMP_COEFF", self.temp_coeff, minval=-1.0, maxval=1.0)
        reference_c = gcmd.get_float("REF_TEMP", None, minval=-273.15)
        self.is_enabled, self.temp_coeff = bool(is_enabled), coeff
        if reference_c is not None:
            self._reference_c, self._reference_overridden = reference_c, True
        reference = "not homed yet" if self._reference_c is None else f"{self._reference_c:.2f} degrees C"
        gcmd.respond_info(
            f"enable: {bool(is_enabled)}\ntemp_coeff: {coeff:.5f} mm/degC\nref_temp: {reference}\n"
            f"{'(manual override)' if self._reference_overridden else '(from homing)'}\n"
            f"Current Z temp: {self.sensor.temp_c:.2f} degrees C\nApplied Z adjustment: {self.adjust_mm:.4f} mm"
        )

    def get_temp(self, eventtime: float) -> tuple[float, float]:
        return self.sensor.temp_c, 0.0

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {
            **self.sensor.get_status(eventtime),
            "current_z_adjust": self.adjust_mm,
            "z_adjust_ref_temperature": self._reference_c or 0.0,
            "enabled": self.is_enabled,
        }


def load_config(config: ConfigWrapper) -> ZThermalAdjust:
    adjust = ZThermalAdjust(config)
    config.get_printer().lookup_object("heaters").register_sensor(config, adjust)
    return adjust
