"""[temperature_probe NAME]: the temperature of a probe's coil, and the drift calibration of [probe_eddy_current]."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .eddy.drift_calibration import DriftCalibration, DriftSettings
from .probing.smoothed import SmoothedSensor


class TemperatureProbe(SmoothedSensor):
    """Printer object 'temperature_probe NAME'."""

    def __init__(self, config: ConfigWrapper) -> None:
        super().__init__(config)
        self.printer = config.get_printer()
        self._calibration = DriftCalibration(self, DriftSettings.read(config))
        gcode = self.printer.lookup_object("gcode")
        for command, text in (
            ("TEMPERATURE_PROBE_CALIBRATE", "Calibrate probe temperature drift compensation"),
            ("TEMPERATURE_PROBE_ENABLE", "Set adjustment mode of the probe temperature drift compensation"),
        ):
            handler = getattr(self, f"cmd_{command}")
            gcode.register_mux_command(command, "PROBE", self.name, handler, desc=text)
            if config.get_prefix_sections("temperature_probe")[0].get_name() == config.get_name():
                gcode.register_mux_command(command, "PROBE", None, handler, desc=text)

    def _coil(self) -> Any:
        owner = self.printer.lookup_object(f"probe_eddy_current {self.name}", None)
        return None if owner is None else owner.coil

    def cmd_TEMPERATURE_PROBE_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """TEMPERATURE_PROBE_CALIBRATE [PROBE=name] TARGET=°C [STEP=2]"""
        self._calibration.begin(gcmd)

    def cmd_TEMPERATURE_PROBE_ENABLE(self, gcmd: GCodeCommand) -> None:
        """TEMPERATURE_PROBE_ENABLE ENABLE=0|1"""
        coil = self._coil()
        if coil is None:
            raise gcmd.error(f"{gcmd.get_command()} needs a section [probe_eddy_current {self.name}]")
        coil.compensates = bool(gcmd.get_int("ENABLE", minval=0, maxval=1))

    def get_status(self, eventtime: float) -> dict[str, Any]:
        coil = self._coil()
        return {
            **super().get_status(eventtime),
            "in_calibration": self._calibration.is_active,
            "estimated_expansion": 0.0,
            "compensation_enabled": coil is not None and coil.drift is not None and coil.compensates,
        }


def load_config_prefix(config: ConfigWrapper) -> TemperatureProbe:
    probe = TemperatureProbe(config)
    config.get_printer().lookup_object("heaters").register_sensor(config, probe)
    return probe
