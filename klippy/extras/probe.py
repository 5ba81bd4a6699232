"""[probe]: a switch that finds the bed.

    Sampling        how a point is probed, and what several samples come to
    PrinterProbe    printer object 'probe': commands, `probe:z_virtual_endstop`, and what other modules call

All heights are the nozzle's at the trigger, in the toolhead's coordinates: the bed is z_offset below.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from configfile import ConfigWrapper
from gcode import Coord, GCodeCommand

from . import manual_probe
from .probing.points import ProbePointsHelper
from .probing.series import Series
from .probing.switch import ProbeEvents, ProbeSwitch

# PROBE_CALIBRATE brings the nozzle to where the probe was, this far above the trigger, at this speed.
CALIBRATE_LIFT_MM = 5.0
CALIBRATE_TRAVEL_MM_S = 50.0
ACCURACY_SAMPLES = 10
# For messages of plugins
HINT_TIMEOUT = "The probe did not trigger: check its wiring, and that it is above the bed."
RESULTS: dict[str, Callable[[list[float]], float]] = {
    "average": statistics.fmean,
    "median": statistics.median,
}


class ProbeOffsets(NamedTuple):
    """Place of the probe against the nozzle, and height of the nozzle at the trigger; mm."""

    x: float
    y: float
    z: float


@dataclass(frozen=True, slots=True)
class Sampling:
    """mm, mm/s."""

    probe_speed: float
    lift_speed: float
    samples: int
    retract_dist: float
    tolerance: float
    retries: int
    result: str  # a key of RESULTS

    @staticmethod
    def read(config: ConfigWrapper) -> Sampling:
        speed = config.getfloat("speed", 5.0, above=0.0)
        return Sampling(
            speed,
            config.getfloat("lift_speed", speed, above=0.0),
            config.getint("samples", 1, minval=1),
            config.getfloat("sample_retract_dist", 2.0, above=0.0),
            config.getfloat("samples_tolerance", 0.100, minval=0.0),
            config.getint("samples_tolerance_retries", 0, minval=0),
            config.getchoice("samples_result", list(RESULTS), "average"),
        )

    def changed_by(self, gcmd: GCodeCommand) -> Sampling:
        """With the parameters of a command."""
        result = gcmd.get("SAMPLES_RESULT", self.result).lower()
        if result not in RESULTS:
            raise gcmd.error(f"SAMPLES_RESULT is '{result}'; it can be {' or '.join(RESULTS)}")
        return replace(
            self,
            probe_speed=gcmd.get_float("PROBE_SPEED", self.probe_speed, above=0.0),
            lift_speed=gcmd.get_float("LIFT_SPEED", self.lift_speed, above=0.0),
            samples=gcmd.get_int("SAMPLES", self.samples, minval=1),
            retract_dist=gcmd.get_float("SAMPLE_RETRACT_DIST", self.retract_dist, above=0.0),
            tolerance=gcmd.get_float("SAMPLES_TOLERANCE", self.tolerance, minval=0.0),
            retries=gcmd.get_int("SAMPLES_TOLERANCE_RETRIES", self.retries, minval=0),
            result=result,
        )


class PrinterProbe:
    """Printer object 'probe'."""

    def __init__(self, config: ConfigWrapper, mcu_probe: Any) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name()
        self.mcu_probe = mcu_probe
        self.sampling = Sampling.read(config)
        self.offsets = ProbeOffsets(
            config.getfloat("x_offset", 0.0), config.getfloat("y_offset", 0.0), config.getfloat("z_offset")
        )
        self._series = False
        self._results: list[list[float]] = []
        self._status = {
            "name": self.name,
            "last_query": False,
            "last_z_result": 0.0,
            "last_probe_position": Coord(0.0, 0.0, 0.0, 0.0),
        }
        ProbeEvents(self.printer, mcu_probe)
        self.printer.register_event_handler("gcode:command_error", self._end_series)
        self.printer.lookup_object("pins").register_chip("probe", self)
        self._register_commands()

    def _register_commands(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        for name, text in (
            ("PROBE", "Probe Z-height at current XY position"),
            ("QUERY_PROBE", "Return the status of the z-probe"),
            ("PROBE_CALIBRATE", "Calibrate the probe's z_offset"),
            ("PROBE_ACCURACY", "Probe Z-height accuracy at current XY position"),
            ("Z_OFFSET_APPLY_PROBE", "Adjust the probe's z_offset"),
        ):
            gcode.register_command(name, getattr(self, f"cmd_{name}"), desc=text)

    def setup_pin(self, pin_type: str, pin_params: dict[str, Any]) -> Any:
        """Called by pins for `probe:z_virtual_endstop`."""
        pins = self.printer.lookup_object("pins")
        if pin_type != "endstop" or pin_params["pin"] != "z_virtual_endstop":
            raise pins.error("Probe virtual endstop only useful as endstop pin: probe:z_virtual_endstop")
        if pin_params["invert"] or pin_params["pullup"]:
            raise pins.error("Can not pullup/invert probe virtual endstop; do so with the probe's own pin")
        return self.mcu_probe

    # -- what others ask --

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return self._status

    def get_offsets(self, gcmd: Any = None) -> ProbeOffsets:
        return self.offsets

    def get_lift_speed(self, gcmd: Any = None) -> float:
        return self.get_sampling(gcmd).lift_speed

    def get_sampling(self, gcmd: Any = None) -> Sampling:
        return self.sampling if gcmd is None else self.sampling.changed_by(gcmd)

    def get_probe_params(self, gcmd: Any = None) -> dict[str, Any]:
        """The same for plugins."""
        s = self.get_sampling(gcmd)
        return {
            "probe_speed": s.probe_speed,
            "lift_speed": s.lift_speed,
            "samples": s.samples,
            "sample_retract_dist": s.retract_dist,
            "samples_tolerance": s.tolerance,
            "samples_tolerance_retries": s.retries,
            "samples_result": s.result,
        }

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
        status = toolhead.get_status(self.printer.get_reactor().monotonic())
        if "z" not in status["homed_axes"]:
            raise self.printer.command_error("Must home before probe")
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

    def _sample(self, gcmd: GCodeCommand, sampling: Sampling) -> list[list[float]]:
        """As many samples as asked for, all within the tolerance."""
        toolhead = self.printer.lookup_object("toolhead")
        start = toolhead.get_position()
        places: list[list[float]] = []
        retries = 0
        while len(places) < sampling.samples:
            places.append(self._touch(sampling.probe_speed))
            heights = [place[2] for place in places]
            if max(heights) - min(heights) > sampling.tolerance:
                if retries >= sampling.retries:
                    raise gcmd.error(
                        f"Probe samples exceed samples_tolerance: they differ by {max(heights) - min(heights):.4f} mm"
                    )
                gcmd.respond_info("Probe samples exceed tolerance. Retrying...")
                retries += 1
                places = []
            if len(places) < sampling.samples:
                lifted = toolhead.get_position()[2] + sampling.retract_dist
                toolhead.manual_move([start[0], start[1], lifted], sampling.lift_speed)
        return places

    def run_probe(self, gcmd: GCodeCommand) -> list[float]:
        """Probe here; returns x, y of the nozzle and its height at the trigger (mm)."""
        sampling = self.get_sampling(gcmd)
        alone = not self._series
        if alone:
            self.multi_probe_begin()
        places = self._sample(gcmd, sampling)
        if alone:
            self.multi_probe_end()
        combine = RESULTS[sampling.result]
        result = [combine([place[axis] for place in places]) for axis in range(3)]
        offsets = self.offsets
        place = Coord(result[0] + offsets.x, result[1] + offsets.y, result[2] - offsets.z, 0.0)
        self._status = {**self._status, "last_z_result": result[2], "last_probe_position": place}
        self._results.append(result)
        return result

    # -- commands --

    def cmd_PROBE(self, gcmd: GCodeCommand) -> None:
        """PROBE [PROBE_SPEED=] [LIFT_SPEED=] [SAMPLES=] [SAMPLE_RETRACT_DIST=] [SAMPLES_TOLERANCE=] ..."""
        gcmd.respond_info(f"Result is z={self.run_probe(gcmd)[2]:.6f}")

    def cmd_QUERY_PROBE(self, gcmd: GCodeCommand) -> None:
        """Is it triggered?"""
        print_time = self.printer.lookup_object("toolhead").get_last_move_time()
        triggered = bool(self.mcu_probe.query_endstop(print_time))
        self._status = {**self._status, "last_query": triggered}
        gcmd.respond_info(f"probe: {'TRIGGERED' if triggered else 'open'}")

    def cmd_PROBE_ACCURACY(self, gcmd: GCodeCommand) -> None:
        """As PROBE, with the statistics of SAMPLES (10) samples."""
        sampling = replace(
            self.get_sampling(gcmd), samples=gcmd.get_int("SAMPLES", ACCURACY_SAMPLES, minval=1)
        )
        toolhead = self.printer.lookup_object("toolhead")
        x, y, z = toolhead.get_position()[:3]
        gcmd.respond_info(
            f"PROBE_ACCURACY at X:{x:.3f} Y:{y:.3f} Z:{z:.3f} (samples={sampling.samples} "
            f"retract={sampling.retract_dist:.3f} speed={sampling.probe_speed:.1f} "
            f"lift_speed={sampling.lift_speed:.1f})"
        )
        self.multi_probe_begin()
        heights = []
        for _ in range(sampling.samples):
            heights.append(self._touch(sampling.probe_speed)[2])
            lifted = toolhead.get_position()[2] + sampling.retract_dist
            toolhead.manual_move([x, y, lifted], sampling.lift_speed)
        self.multi_probe_end()
        gcmd.respond_info(
            f"probe accuracy results: maximum {max(heights):.6f}, minimum {min(heights):.6f}, "
            f"range {max(heights) - min(heights):.6f}, average {statistics.fmean(heights):.6f}, "
            f"median {statistics.median(heights):.6f}, standard deviation {statistics.pstdev(heights):.6f}"
        )

    def cmd_PROBE_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """Probe, then the paper test at the same place of the bed: the difference is z_offset."""
        manual_probe.verify_no_manual_probe(self.printer)
        gcmd.get_float("SPEED", None, above=0.0)  # of the paper test: wrong before anything moves
        sampling = self.get_sampling(gcmd)
        toolhead = self.printer.lookup_object("toolhead")
        x, y, probed_mm = self.run_probe(gcmd)
        toolhead.manual_move([None, None, probed_mm + CALIBRATE_LIFT_MM], sampling.lift_speed)
        toolhead.manual_move([x + self.offsets.x, y + self.offsets.y], CALIBRATE_TRAVEL_MM_S)

        def finalize(place: Sequence[float] | None) -> None:
            if place is not None:
                self._propose(gcmd, probed_mm - place[2])

        manual_probe.ManualProbeHelper(self.printer, gcmd, finalize)

    def _propose(self, gcmd: GCodeCommand, z_offset: float) -> None:
        manual_probe.report_save_config(gcmd, f"{self.name}: z_offset: {z_offset:.3f}")
        self.printer.lookup_object("configfile").set(self.name, "z_offset", f"{z_offset:.3f}")

    def cmd_Z_OFFSET_APPLY_PROBE(self, gcmd: GCodeCommand) -> None:
        """Take SET_GCODE_OFFSET Z=… over into z_offset."""
        offset_mm = self.printer.lookup_object("gcode_move").get_status()["homing_origin"].z
        if not offset_mm:
            gcmd.respond_info("Nothing to do: Z Offset is 0")
            return
        self._propose(gcmd, self.offsets.z - offset_mm)


def run_single_probe(probe: Any, gcmd: GCodeCommand) -> list[float]:
    """Probe here (plugins call it so)."""
    series = Series(probe, gcmd)
    place = series.run()
    series.end()
    return place


ProbeEndstopWrapper = ProbeSwitch  # the name plugins know

__all__: Sequence[str] = (
    "PrinterProbe", "ProbeEndstopWrapper", "ProbeOffsets", "ProbePointsHelper", "ProbeSwitch", "Sampling",
    "load_config", "run_single_probe",
)  # fmt: skip


def load_config(config: ConfigWrapper) -> PrinterProbe:
    return PrinterProbe(config, ProbeSwitch(config))
