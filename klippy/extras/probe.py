"""[probe]: a switch that finds the bed.

    probing/sampling.py    how a point is probed, and what several samples come to
    probing/commands.py    PROBE, PROBE_CALIBRATE and others
    probing/helpers.py     the same parts for plugins
    PrinterProbe           printer object 'probe': `probe:z_virtual_endstop`, and what other modules call

All heights are the nozzle's at the trigger, in the toolhead's coordinates: the bed is z_offset below.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from configfile import ConfigWrapper
from gcode import GCodeCommand

from . import manual_probe
from .probing.commands import ProbeCommands
from .probing.helpers import (
    HomingViaProbeHelper,
    ProbeCommandHelper,
    ProbeOffsetsHelper,
    ProbeParameterHelper,
    ProbeSessionHelper,
    calc_probe_z_average,
    check_virtual_endstop,
)  # fmt: skip
from .probing.points import ProbePointsHelper
from .probing.sampling import Sampling, check_homed, take_samples
from .probing.series import Series
from .probing.switch import ProbeEvents, ProbeSwitch

# For messages of plugins
HINT_TIMEOUT = "The probe did not trigger: check its wiring, and that it is above the bed."


class ProbeOffsets(NamedTuple):
    """Place of the probe against the nozzle, and height of the nozzle at the trigger; mm."""

    x: float
    y: float
    z: float


class PrinterProbe:
    """Printer object 'probe'."""

    def __init__(self, config: ConfigWrapper, mcu_probe: Any) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name()
        self.mcu_probe = mcu_probe
        self.sampling = Sampling.read(config)
        self.offsets = ProbeOffsets(
            config.getfloat("x_offset", 0.0), config.getfloat("y_offset", 0.0), self._read_height(config)
        )
        self._series = False
        self._results: list[list[float]] = []
        self.commands = ProbeCommands(self.printer, self.name, self, mcu_probe.query_endstop)
        self.commands.register()
        ProbeEvents(self.printer, mcu_probe)
        self.printer.register_event_handler("gcode:command_error", self._end_series)
        self.printer.lookup_object("pins").register_chip("probe", self)

    @staticmethod
    def _read_height(config: ConfigWrapper) -> float:
        """Height of the nozzle at the trigger."""
        return config.getfloat("z_offset")

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> Any:
        """Called by pins for `probe:z_virtual_endstop`."""
        return check_virtual_endstop(self.printer, pin_type, pin_params, self.mcu_probe)

    # -- what others ask --

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return self.commands.get_status(eventtime)

    def get_offsets(self, gcmd: Any = None) -> ProbeOffsets:
        return self.offsets

    def get_lift_speed(self, gcmd: Any = None) -> float:
        return self.get_sampling(gcmd).lift_speed

    def get_sampling(self, gcmd: Any = None) -> Sampling:
        return self.sampling.changed_by(gcmd)

    def get_probe_params(self, gcmd: Any = None) -> dict[str, Any]:
        """The same for plugins."""
        return self.get_sampling(gcmd).as_params()

    def multi_probe_begin(self) -> None:
        """Several points follow."""
        self.mcu_probe.multi_probe_begin()
        self._series = True

    def multi_probe_end(self) -> None:
        if self._series:
            self._series = False
            self.mcu_probe.multi_probe_end()

    def _end_series(self) -> None:
        """A command has failed."""
        try:
            self.multi_probe_end()
        except self.printer.command_error as e:
            self.printer.lookup_object("gcode").respond_info(str(e))

    def start_probe_session(self, gcmd: GCodeCommand) -> PrinterProbe:
        """The newer way to say multi_probe_begin: run_probe() as often as wanted, pull_probed_results()."""
        self._results = []
        self.multi_probe_begin()
        return self

    def pull_probed_results(self) -> list[list[float]]:
        results, self._results = self._results, []
        return results

    def end_probe_session(self) -> None:
        self.multi_probe_end()

    # -- probing --

    def _touch(self, speed: float) -> list[float]:
        """One move down to the trigger."""
        toolhead = self.printer.lookup_object("toolhead")
        status = check_homed(self.printer)
        target = toolhead.get_position()
        target[2] = status["axis_minimum"][2]
        place = list(self.mcu_probe.probing_move(target, speed))
        place[2] = self._corrected(place)
        self.printer.lookup_object("gcode").respond_info(
            f"probe at {place[0]:.3f},{place[1]:.3f} is z={place[2]:.6f}"
        )
        return place[:3]

    def _corrected(self, place: Sequence[float]) -> float:
        """The height after [axis_twist_compensation] and plugins have seen it."""
        x, y, z = place[:3]
        offsets = self.offsets
        results = [manual_probe.ProbeResult(x + offsets.x, y + offsets.y, z - offsets.z, x, y, z)]
        self.printer.send_event("probe:update_results", results)
        return float(results[0].bed_z + offsets.z)

    def run_probe(self, gcmd: GCodeCommand) -> list[float]:
        """Probe here; returns x, y of the nozzle and its height at the trigger (mm)."""
        sampling = self.get_sampling(gcmd)
        alone = not self._series
        if alone:
            self.multi_probe_begin()
        places = take_samples(self.printer, gcmd, sampling, self._touch)
        if alone:
            self.multi_probe_end()
        result = sampling.combine(places)
        self.commands.note_result(result)
        self._results.append(result)
        return result


def run_single_probe(probe: Any, gcmd: GCodeCommand) -> list[float]:
    """Probe here (plugins call it so)."""
    series = Series(probe, gcmd)
    place = series.run()
    series.end()
    return place


ProbeEndstopWrapper = ProbeSwitch  # the name plugins know

__all__: Sequence[str] = (
    "HomingViaProbeHelper", "PrinterProbe", "ProbeCommandHelper", "ProbeEndstopWrapper", "ProbeOffsets",
    "ProbeOffsetsHelper", "ProbeParameterHelper", "ProbePointsHelper", "ProbeSessionHelper", "ProbeSwitch", "Sampling",
    "calc_probe_z_average", "load_config", "run_single_probe",
)  # fmt: skip


def load_config(config: ConfigWrapper) -> PrinterProbe:
    return PrinterProbe(config, ProbeSwitch(config))
