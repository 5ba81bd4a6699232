"""PROBE_EDDY_CURRENT_CALIBRATE and PROBE_EDDY_CURRENT_TAP_CALIBRATE.

The paper test says where the bed is below the nozzle; then the coil is moved above that place, and its frequency is
measured at heights that are known so.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from gcode import GCodeCommand

from .. import manual_probe
from ..probing.stream import Gathering, Sample
from .curve import Curve
from .probe import MEASURE_S, SETTLE_S, EddyProbe
from .tap import GUESS_SHARE

FIRST_MM, LAST_MM, STEP_MM = 0.05, 4.05, 0.04
CLEARANCE_MM, PLAY_MM = 5.0, 0.5
TRAVEL_MM_S, LIFT_MM_S = 50.0, 5.0
REPORTED_MM = (0.25, 0.53, 1.01, 2.01, 3.01)
TAP_VERIFY = 5
VERIFY_RANGE_MM = 0.02


def measure_heights(
    probe: EddyProbe, bed_mm: float, heights_mm: Sequence[float]
) -> list[tuple[float, list[Sample], float | None]]:
    """(height, samples at rest there, coil's temperature) above a bed that the nozzle meets at bed_mm."""
    toolhead = probe.printer.lookup_object("toolhead")
    gathering = Gathering(probe.coil.chip.stream)
    found = []
    try:
        toolhead.manual_move([None, None, bed_mm + max(heights_mm) + PLAY_MM], LIFT_MM_S)
        for height in sorted(
            heights_mm, reverse=True
        ):  # always from above: the play of the screw is on one side
            toolhead.manual_move([None, None, bed_mm + height], LIFT_MM_S)
            start = toolhead.get_last_move_time() + SETTLE_S
            toolhead.dwell(SETTLE_S + MEASURE_S)
            gathering.wait_until(start + MEASURE_S)
            samples = gathering.between(start, start + MEASURE_S)
            found.append((height, samples, probe.coil.temperature()))
        toolhead.manual_move([None, None, bed_mm + CLEARANCE_MM], LIFT_MM_S)
    finally:
        gathering.end()
    return found


def move_coil_over_nozzle(probe: EddyProbe, place: Sequence[float]) -> None:
    """Up, and the coil above the place where the nozzle was."""
    toolhead = probe.printer.lookup_object("toolhead")
    toolhead.manual_move([None, None, place[2] + CLEARANCE_MM], LIFT_MM_S)
    toolhead.manual_move([place[0] - probe.offsets.x, place[1] - probe.offsets.y], TRAVEL_MM_S)


class EddyCalibration:
    """The commands of one probe."""

    def __init__(self, probe: EddyProbe) -> None:
        self.probe = probe
        self.printer = probe.printer
        self._slope_hz_mm: float | None = None  # of the last tap
        self._threshold = probe.tap_threshold
        gcode = self.printer.lookup_object("gcode")
        gcode.register_mux_command(
            "PROBE_EDDY_CURRENT_CALIBRATE",
            "CHIP",
            probe.coil.chip.name,
            self.cmd_PROBE_EDDY_CURRENT_CALIBRATE,
            desc="Calibrate eddy current probe",
        )
        gcode.register_command(
            "PROBE_EDDY_CURRENT_TAP_CALIBRATE",
            self.cmd_PROBE_EDDY_CURRENT_TAP_CALIBRATE,
            desc="Calibrate the tap_threshold of an eddy current probe",
        )

    def cmd_PROBE_EDDY_CURRENT_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """PROBE_EDDY_CURRENT_CALIBRATE CHIP=name: the paper test, then the heights."""
        manual_probe.verify_no_manual_probe(self.printer)

        def finalize(place: Sequence[float] | None) -> None:
            if place is not None:
                self._calibrate(gcmd, place)

        manual_probe.ManualProbeHelper(self.printer, gcmd, finalize)

    def _calibrate(self, gcmd: GCodeCommand, place: Sequence[float]) -> None:
        coil = self.probe.coil
        move_coil_over_nozzle(self.probe, place)
        count = round((LAST_MM - FIRST_MM) / STEP_MM) + 1
        heights = [FIRST_MM + STEP_MM * number for number in range(count)]
        found = measure_heights(self.probe, place[2], heights)
        if coil.chip.mcu.is_fileoutput():
            return
        try:
            curve = Curve([(height, coil.mean_hz(samples)) for height, samples, _ in found])
        except ValueError as e:
            raise gcmd.error(
                f"The calibration has failed: {e}. Is the coil above the bed, with the right current?"
            ) from None
        self._report(gcmd, curve, found)
        coil.curve = curve
        configfile = self.printer.lookup_object("configfile")
        section = self.probe.name
        configfile.set(section, "calibrate", curve.text())
        temps = [temp_c for _, _, temp_c in found if temp_c is not None]
        if temps:
            coil.calibration_c = temp_c = statistics.fmean(temps)
            configfile.set(section, "calibration_temp", f"{temp_c:.3f}")
        manual_probe.report_save_config(gcmd, f"{section}: calibrate, {len(found)} heights")

    def _report(
        self, gcmd: GCodeCommand, curve: Curve, found: list[tuple[float, list[Sample], float | None]]
    ) -> None:
        lines, noises, total = [], [], 0
        for height, samples, _ in sorted(found):
            values = [hz for _, hz in samples]
            middle = statistics.median(values)
            mad_hz = statistics.median(abs(hz - middle) for hz in values)
            noise_mm = statistics.pstdev(curve.height_mm(hz) for hz in values)
            noises.append((noise_mm, mad_hz))
            total += len(values)
            if any(abs(height - reported) < 0.5 * STEP_MM for reported in REPORTED_MM):
                lines.append(f"z: {height:.3f} # noise {noise_mm:.6f}mm, MAD_Hz={mad_hz:.3f}")
        low, high = curve.range_mm
        noise_mm, mad_hz = (statistics.fmean(column) for column in zip(*noises, strict=True))
        gcmd.respond_info(
            f"probe_eddy_current: noise {noise_mm:.6f}mm, MAD_Hz={mad_hz:.3f} in {total} queries\n"
            f"Total frequency range: {curve.hz(low) - curve.hz(high):.3f} Hz\n" + "\n".join(lines)
        )

    # -- tap --

    def cmd_PROBE_EDDY_CURRENT_TAP_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """PROBE_EDDY_CURRENT_TAP_CALIBRATE TAP=guess|refine|verify, one after the other."""
        stage = gcmd.get("TAP", "guess").lower()
        if stage == "guess":
            slope = self.probe.coil.require_curve().slope_hz_mm(0.1)
            self._tap(gcmd, GUESS_SHARE * slope)
        elif stage == "refine":
            if self._slope_hz_mm is None:
                raise gcmd.error("TAP=refine needs a tap before: TAP=guess first")
            self._tap(gcmd, GUESS_SHARE * self._slope_hz_mm)
        elif stage == "verify":
            self._verify(gcmd)
        else:
            raise gcmd.error(f"TAP is '{stage}'; it can be guess, refine or verify")

    def _tap(self, gcmd: GCodeCommand, threshold: float) -> float:
        gcmd.respond_info(f"tap_threshold: {threshold:.0f}")
        toolhead = self.printer.lookup_object("toolhead")
        start = toolhead.get_position()[2]
        place = self.probe.run_tap(gcmd, threshold)
        self._slope_hz_mm, self._threshold = self.probe.last_tap_slope, threshold
        toolhead.manual_move([None, None, start], LIFT_MM_S)
        return place[2]

    def _verify(self, gcmd: GCodeCommand) -> None:
        if self._threshold is None:
            raise gcmd.error("TAP=verify needs a threshold: TAP=guess and TAP=refine first")
        heights = [self._tap(gcmd, self._threshold) for _ in range(TAP_VERIFY)]
        spread = max(heights) - min(heights)
        gcmd.respond_info(f"{TAP_VERIFY} taps within {spread:.4f} mm")
        if spread > VERIFY_RANGE_MM:
            raise gcmd.error(
                f"The taps differ by more than {VERIFY_RANGE_MM} mm: clean the nozzle, and probe slower"
            )
        self.probe.tap_threshold = self._threshold
        self.printer.lookup_object("configfile").set(
            self.probe.name, "tap_threshold", f"{self._threshold:.1f}"
        )
        manual_probe.report_save_config(gcmd, f"{self.probe.name}: tap_threshold: {self._threshold:.1f}")
