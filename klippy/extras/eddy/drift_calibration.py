"""TEMPERATURE_PROBE_CALIBRATE: the coil's frequency at some heights, over its temperature.

paper test ─► samples at each height ─► rest near the bed, until the coil is STEP warmer ─► paper test again ...
TEMPERATURE_PROBE_NEXT: now     TEMPERATURE_PROBE_COMPLETE: that was enough     ABORT: nothing is kept
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .. import manual_probe
from .calibrate import LIFT_MM_S, measure_heights, move_coil_over_nozzle
from .drift import MIN_TEMPERATURES, Drift, Parabola, fit

HEIGHTS_MM = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)
LOOK_S = 1.0
COMMANDS = {
    "TEMPERATURE_PROBE_NEXT": "Take the next sample of the drift calibration",
    "TEMPERATURE_PROBE_COMPLETE": "End the drift calibration with the samples so far",
    "ABORT": "Give up the drift calibration",
}


@dataclass(frozen=True, slots=True)
class DriftSettings:
    """Options of [temperature_probe]."""

    speed: float | None
    horizontal_move_z: float
    resting_z: float
    extruder_heating_z: float
    position: tuple[float, ...] | None
    bed_c: float | None
    extruder_c: float | None
    max_validation_c: float

    @staticmethod
    def read(config: ConfigWrapper) -> DriftSettings:
        return DriftSettings(
            config.getfloat("speed", None, above=0.0),
            config.getfloat("horizontal_move_z", 2.0, above=0.0),
            config.getfloat("resting_z", 0.4, above=0.0),
            config.getfloat("extruder_heating_z", 50.0, above=0.0),
            config.getfloatlist("calibration_position", None, count=3),
            config.getfloat("calibration_bed_temp", None, minval=0.0),
            config.getfloat("calibration_extruder_temp", None, minval=0.0),
            config.getfloat("max_validation_temp", 60.0, minval=0.0),
        )


class DriftCalibration:
    """The dialogue of one probe; `sensor` is its temperature_probe."""

    def __init__(self, sensor: Any, settings: DriftSettings) -> None:
        self._sensor, self._settings = sensor, settings
        self.printer = sensor.printer
        self.reactor = self.printer.get_reactor()
        self.is_active = False
        self._samples: dict[float, list[tuple[float, float]]] = {}  # height: (temperature, frequency)
        self._target_c = self._step_c = self._next_c = 0.0
        self._gcmd: Any = None
        self._timer = self.reactor.register_timer(self._look)
        self._busy = False  # a paper test, or samples

    # -- beginning and end --

    def begin(self, gcmd: GCodeCommand) -> None:
        """TEMPERATURE_PROBE_CALIBRATE [TARGET=°C] [STEP=2]. Raises command_error."""
        manual_probe.verify_no_manual_probe(self.printer)
        probe = self._probe(gcmd)
        probe.coil.require_curve()
        if probe.coil.calibration_c is None:
            raise gcmd.error(
                "PROBE_EDDY_CURRENT_CALIBRATE must be run again first: it notes the temperature of its calibration"
            )
        now_c = self._sensor.temp_c
        self._target_c = gcmd.get_float("TARGET", above=now_c)
        self._step_c = gcmd.get_float("STEP", 2.0, minval=0.5)
        if (self._target_c - now_c) / self._step_c < MIN_TEMPERATURES - 1:
            raise gcmd.error(
                f"From {now_c:.1f} to TARGET={self._target_c:g} in STEP={self._step_c:g} are too few temperatures:"
                f" {MIN_TEMPERATURES} are needed"
            )
        self._samples = {height: [] for height in HEIGHTS_MM}
        self._gcmd, self.is_active = gcmd, True
        self._heat_extruder()
        self._ask()

    def _probe(self, gcmd: GCodeCommand) -> Any:
        owner = self.printer.lookup_object(f"probe_eddy_current {self._sensor.name}", None)
        if owner is None:
            raise gcmd.error(f"{gcmd.get_command()} needs a section [probe_eddy_current {self._sensor.name}]")
        return owner.probe

    def _heat_extruder(self) -> None:
        settings = self._settings
        toolhead = self.printer.lookup_object("toolhead")
        speed = settings.speed or 50.0
        gcode = self.printer.lookup_object("gcode")
        if settings.extruder_c is not None:
            toolhead.manual_move([None, None, settings.extruder_heating_z], LIFT_MM_S)
            gcode.run_script_from_command(f"M109 S{settings.extruder_c}")
        if settings.position is not None:
            toolhead.manual_move([settings.position[0], settings.position[1]], speed)
            toolhead.manual_move([None, None, settings.position[2]], LIFT_MM_S)

    def _register(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        for command, text in COMMANDS.items():
            gcode.register_command(command, None)
            gcode.register_command(command, getattr(self, f"cmd_{command}"), desc=text)

    def _end(self) -> None:
        self.is_active = False
        self.reactor.update_timer(self._timer, self.reactor.NEVER)
        gcode = self.printer.lookup_object("gcode")
        for command in COMMANDS:
            gcode.register_command(command, None)
        settings = self._settings
        if settings.bed_c is not None:
            gcode.run_script_from_command("M140 S0")
        if settings.extruder_c is not None:
            gcode.run_script_from_command("M104 S0")

    # -- samples --

    def _ask(self) -> None:
        """The paper test at the temperature now."""
        self._busy = True
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command("ABORT", None)  # the paper test has its own
        manual_probe.ManualProbeHelper(self.printer, self._gcmd, self._finish_paper)

    def _finish_paper(self, place: Sequence[float] | None) -> None:
        self._busy = False
        if place is None:
            self._end()
            self._gcmd.respond_info("Drift calibration aborted")
            return
        probe = self._probe(self._gcmd)
        move_coil_over_nozzle(probe, place)
        self._busy = True
        for height, samples, at_c in measure_heights(probe, place[2], HEIGHTS_MM):
            self._samples[height].append((at_c or 0.0, probe.coil.mean_hz(samples)))
        temp_c = self._sensor.temp_c
        self._busy = False
        count = len(self._samples[HEIGHTS_MM[0]])
        self._gcmd.respond_info(f"Drift calibration: sample {count} at {temp_c:.2f} C")
        self._register()
        if temp_c >= self._target_c:
            self.complete(self._gcmd)
            return
        self._rest(place)
        if count == 1 and self._settings.bed_c is not None:
            gcode = self.printer.lookup_object("gcode")
            gcode.run_script_from_command(f"M140 S{self._settings.bed_c}")
        self._next_c = min(temp_c + self._step_c, self._target_c)
        self.reactor.update_timer(self._timer, self.reactor.NOW)

    def _rest(self, place: Sequence[float]) -> None:
        """Nozzle over its place again, near the bed, where the coil warms up."""
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.manual_move([place[0], place[1]], self._settings.speed or 50.0)
        toolhead.manual_move([None, None, place[2] + self._settings.resting_z], LIFT_MM_S)

    def _look(self, eventtime: float) -> float:
        """Timer: is it time for the next sample?"""
        if not self.is_active or self._busy:
            return float(self.reactor.NEVER)
        if self._sensor.temp_c < self._next_c:
            return eventtime + LOOK_S
        gcode = self.printer.lookup_object("gcode")
        self.reactor.register_callback(lambda t: gcode.run_script("TEMPERATURE_PROBE_NEXT"))
        return float(self.reactor.NEVER)

    def complete(self, gcmd: GCodeCommand) -> None:
        """Fit, use and keep. Raises command_error if there are too few samples."""
        if len(self._samples[HEIGHTS_MM[0]]) < MIN_TEMPERATURES:
            raise gcmd.error(
                f"The drift calibration needs samples at {MIN_TEMPERATURES} temperatures at least"
            )
        self._end()
        probe = self._probe(gcmd)
        parabolas: list[Parabola] = [fit(samples) for samples in self._samples.values()]
        coil = probe.coil
        coil.drift = Drift(parabolas, coil.calibration_c)
        configfile = self.printer.lookup_object("configfile")
        configfile.set(probe.name, "drift_calibration", coil.drift.text())
        low_c = min(temp_c for temp_c, _ in self._samples[HEIGHTS_MM[0]])
        configfile.set(probe.name, "drift_calibration_min_temp", f"{low_c:.2f}")
        manual_probe.report_save_config(gcmd, f"{probe.name}: drift_calibration, {len(parabolas)} heights")

    def cmd_TEMPERATURE_PROBE_NEXT(self, gcmd: GCodeCommand) -> None:
        """Now, whatever the temperature is."""
        if not self._busy:
            self._ask()

    def cmd_TEMPERATURE_PROBE_COMPLETE(self, gcmd: GCodeCommand) -> None:
        """The samples so far are enough."""
        self.complete(gcmd)

    def cmd_ABORT(self, gcmd: GCodeCommand) -> None:
        """Forget the samples."""
        self._end()
        gcmd.respond_info("Drift calibration aborted")
