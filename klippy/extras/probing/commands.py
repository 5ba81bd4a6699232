"""The commands of a probe: PROBE, QUERY_PROBE, PROBE_ACCURACY, PROBE_CALIBRATE, Z_OFFSET_APPLY_PROBE, and its status.

The probe is ours or a plugin's: it has `get_offsets`, `get_probe_params`, and sessions or `run_probe`.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Any

from gcode import Coord, GCodeCommand
from roles import Printer

from .. import manual_probe
from .series import Series

# PROBE_CALIBRATE brings the nozzle to where the probe was, this far above the trigger, at the speed of [probe].
CALIBRATE_LIFT_MM = 5.0
ACCURACY_SAMPLES = 10


class ProbeCommands:
    """Commands and status of one probe."""

    def __init__(
        self, printer: Printer, name: str, probe: Any, query_endstop: Callable[[float], int] | None = None
    ) -> None:
        self.printer = printer
        self.name = name
        self.probe = probe
        self._query_endstop = query_endstop
        self._status = {
            "name": name,
            "last_query": False,
            "last_z_result": 0.0,
            "last_probe_position": Coord(0.0, 0.0, 0.0, 0.0),
        }

    def register(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        for name, text in (
            ("PROBE", "Probe Z-height at current XY position"),
            ("QUERY_PROBE", "Return the status of the z-probe"),
            ("PROBE_CALIBRATE", "Calibrate the probe's z_offset"),
            ("PROBE_ACCURACY", "Probe Z-height accuracy at current XY position"),
            ("Z_OFFSET_APPLY_PROBE", "Adjust the probe's z_offset"),
        ):
            if name != "QUERY_PROBE" or self._query_endstop is not None:
                gcode.register_command(name, getattr(self, f"cmd_{name}"), desc=text)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return self._status

    def note_result(self, result: Sequence[float]) -> None:
        """A place has been probed: x, y of the nozzle and its height at the trigger."""
        x, y, z = self.probe.get_offsets()
        place = Coord(result[0] + x, result[1] + y, result[2] - z, 0.0)
        self._status = {**self._status, "last_z_result": result[2], "last_probe_position": place}

    def _probe_once(self, gcmd: GCodeCommand) -> list[float]:
        series = Series(self.probe, gcmd)
        place = series.run()
        series.end()
        self.note_result(place)
        return place

    def cmd_PROBE(self, gcmd: GCodeCommand) -> None:
        """PROBE [PROBE_SPEED=] [LIFT_SPEED=] [SAMPLES=] [SAMPLE_RETRACT_DIST=] [SAMPLES_TOLERANCE=] ..."""
        gcmd.respond_info(f"Result is z={self._probe_once(gcmd)[2]:.6f}")

    def cmd_QUERY_PROBE(self, gcmd: GCodeCommand) -> None:
        """Is it triggered?"""
        assert self._query_endstop is not None
        print_time = self.printer.lookup_object("toolhead").get_last_move_time()
        triggered = bool(self._query_endstop(print_time))
        self._status = {**self._status, "last_query": triggered}
        gcmd.respond_info(f"probe: {'TRIGGERED' if triggered else 'open'}")

    def cmd_PROBE_ACCURACY(self, gcmd: GCodeCommand) -> None:
        """As PROBE, with the statistics of SAMPLES (10) samples."""
        params = self.probe.get_probe_params(gcmd)
        count = gcmd.get_int("SAMPLES", ACCURACY_SAMPLES, minval=1)
        toolhead = self.printer.lookup_object("toolhead")
        x, y, z = toolhead.get_position()[:3]
        gcmd.respond_info(
            f"PROBE_ACCURACY at X:{x:.3f} Y:{y:.3f} Z:{z:.3f} (samples={count} "
            f"retract={params['sample_retract_dist']:.3f} speed={params['probe_speed']:.1f} "
            f"lift_speed={params['lift_speed']:.1f})"
        )
        given = {**gcmd.get_command_parameters(), "SAMPLES": "1"}
        gcode = self.printer.lookup_object("gcode")
        series = Series(self.probe, gcode.create_gcode_command("PROBE", "PROBE", given))
        heights = []
        for _ in range(count):
            heights.append(series.run()[2])
            lifted = toolhead.get_position()[2] + params["sample_retract_dist"]
            toolhead.manual_move([x, y, lifted], params["lift_speed"])
        series.end()
        gcmd.respond_info(
            f"probe accuracy results: maximum {max(heights):.6f}, minimum {min(heights):.6f}, "
            f"range {max(heights) - min(heights):.6f}, average {statistics.fmean(heights):.6f}, "
            f"median {statistics.median(heights):.6f}, standard deviation {statistics.pstdev(heights):.6f}"
        )

    def cmd_PROBE_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """Probe, then the paper test at the same place of the bed: the difference is z_offset."""
        manual_probe.verify_no_manual_probe(self.printer)
        gcmd.get_float("SPEED", None, above=0.0)  # of the paper test: wrong before anything moves
        lift_speed = self.probe.get_probe_params(gcmd)["lift_speed"]
        toolhead = self.printer.lookup_object("toolhead")
        x, y, probed_mm = self._probe_once(gcmd)
        offset_x, offset_y = self.probe.get_offsets()[:2]
        toolhead.manual_move([None, None, probed_mm + CALIBRATE_LIFT_MM], lift_speed)
        toolhead.manual_move([x + offset_x, y + offset_y], self.probe.get_probe_params()["probe_speed"])

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
        self._propose(gcmd, self.probe.get_offsets()[2] - offset_mm)
