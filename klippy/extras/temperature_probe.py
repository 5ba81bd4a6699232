"""[temperature_probe NAME]: the temperature of a probe's coil.

Its drift calibration needs [probe_eddy_current NAME], which this program does not have yet: the options are accepted,
the commands say so.
"""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .probing.smoothed import SmoothedSensor


class TemperatureProbe(SmoothedSensor):
    """Printer object 'temperature_probe NAME'."""

    def __init__(self, config: ConfigWrapper) -> None:
        super().__init__(config)
        config.getfloat("speed", None, above=0.0)
        for option, default in (("horizontal_move_z", 2.0), ("resting_z", 0.4), ("extruder_heating_z", 50.0)):
            config.getfloat(option, default, above=0.0)
        config.getfloatlist("calibration_position", None, count=3)
        for option in ("calibration_bed_temp", "calibration_extruder_temp"):
            config.getfloat(option, None, minval=0.0)
        config.getfloat("max_validation_temp", 60.0, minval=0.0)
        gcode = config.get_printer().lookup_object("gcode")
        for command, text in (
            ("TEMPERATURE_PROBE_CALIBRATE", "Calibrate probe temperature drift compensation"),
            ("TEMPERATURE_PROBE_ENABLE", "Set adjustment mode of the probe temperature drift compensation"),
        ):
            gcode.register_mux_command(command, "PROBE", self.name, self._refuse, desc=text)

    def _refuse(self, gcmd: GCodeCommand) -> None:
        raise gcmd.error(
            f"{gcmd.get_command()} needs [probe_eddy_current {self.name}], which Ferrite does not have yet"
        )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {
            **super().get_status(eventtime),
            "in_calibration": False,
            "estimated_expansion": 0.0,
            "compensation_enabled": False,
        }


def load_config_prefix(config: ConfigWrapper) -> TemperatureProbe:
    probe = TemperatureProbe(config)
    config.get_printer().lookup_object("heaters").register_sensor(config, probe)
    return probe
