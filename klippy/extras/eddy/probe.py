"""Probing with a coil: stop at descend_z and measure, measure while passing (scan), or touch the bed (tap).

automatic   down until the frequency is that of descend_z, then the mean of MEASURE_S at rest
scan        at the height where the head is, at rest; rapid_scan: while it passes
tap         down until the frequency stops rising; while the head is lifted the samples show where it left the bed
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from ..probe import PrinterProbe, ProbeOffsets
from ..probing.analog_endstop import AnalogEndstop
from ..probing.filters import Scale
from ..probing.sampling import check_homed
from ..probing.stream import Gathering, Sample
from ..probing.switch import ProbeSwitch
from .chip import CODE_MAX, RATE_HZ, Ldc1612
from .curve import Curve
from .drift import Drift
from .tap import MAX_SECTIONS, Tap

METHODS = ("automatic", "scan", "rapid_scan", "tap")
SETTLE_S, MEASURE_S = 0.03, 0.1
PASS_S = 0.04  # of a point that is passed
APPROACH_S, APPROACH_MM, APPROACH_MIN = 0.2, 0.6, 5  # of the way down, for the time of the trigger
START_MARGIN_MM = 0.1  # the head must be above descend_z by this much
SURE_MM = 0.4  # above the height of the last probing: far enough at other places of the bed, too


class Coil:
    """Heights from the coil's frequency: curve, temperature."""

    def __init__(self, config: ConfigWrapper, chip: Ldc1612) -> None:
        self.printer = config.get_printer()
        self.chip = chip
        self.curve = Curve.read(config)
        self.drift = Drift.read(config)
        self.calibration_c = config.getfloat("calibration_temp", None)
        self.compensates = True

    def temperature(self) -> float | None:
        """Of the coil, by the [temperature_probe] of the same name."""
        sensor = self.printer.lookup_object(f"temperature_probe {self.chip.name}", None)
        return None if sensor is None else float(sensor.temp_c)

    def corrected_hz(self, hz: float) -> float:
        temp_c = self.temperature()
        if self.drift is None or temp_c is None or not self.compensates:
            return hz
        return self.drift.corrected(hz, temp_c)

    def expected_hz(self, hz: float) -> float:
        """Of a frequency of the curve, at the temperature now."""
        temp_c = self.temperature()
        if self.drift is None or temp_c is None or not self.compensates:
            return hz
        return self.drift.expected(hz, temp_c)

    def require_curve(self) -> Curve:
        if self.curve is None:
            raise self.printer.command_error(
                f"[{self.chip.section}] is not calibrated: run PROBE_EDDY_CURRENT_CALIBRATE CHIP={self.chip.name}"
            )
        return self.curve

    def height_mm(self, hz: float) -> float:
        """Of the nozzle above the bed where the coil is."""
        return self.require_curve().height_mm(self.corrected_hz(hz))

    def mean_hz(self, samples: Sequence[Sample]) -> float:
        """Raises the printer's command_error without samples."""
        if not samples:
            raise self.printer.command_error(
                f"[{self.chip.section}] has sent no good sample: check its wiring, and that a bed of metal is below it"
            )
        return statistics.fmean(hz for _, hz in samples)

    def measure(self, gathering: Gathering, duration_s: float = MEASURE_S, waits: bool = True) -> float:
        """Height, once the head has come to rest; `waits`: for the moves that are queued."""
        if waits:
            self.printer.lookup_object("toolhead").wait_moves()
        start = self.chip.mcu.estimated_print_time(self.printer.get_reactor().monotonic()) + SETTLE_S
        gathering.wait_until(start + duration_s)
        if self.chip.mcu.is_fileoutput():
            return self.require_curve().range_mm[0]
        return self.height_mm(self.mean_hz(gathering.between(start, start + duration_s)))


class CoilSwitch(ProbeSwitch):
    """The coil as the switch of a probe."""

    def __init__(self, config: ConfigWrapper, coil: Coil, descend_mm: float) -> None:
        self.printer = config.get_printer()
        self.coil, self.descend_mm = coil, descend_mm
        self._z_offset = descend_mm
        self._each_sample = True
        load = self.printer.load_object(config, "gcode_macro").load_template
        self._activate = load(config, "activate_gcode", "")
        self._deactivate = load(config, "deactivate_gcode", "")
        chip = coil.chip
        self.mcu_endstop = AnalogEndstop(chip.mcu, MAX_SECTIONS, "ldc1612_error:")
        self.mcu_endstop.period_s = 1.0 / RATE_HZ
        chip.mcu.register_config_callback(lambda: chip.attach_trigger(self.mcu_endstop.oid))
        self.tap: Tap | None = None  # under way
        self.measures_at_rest = False  # after the move that is under way: its trigger need not be exact
        self._approach: Gathering | None = None
        self._in_series = self._is_out = False
        self.printer.register_event_handler("klippy:mcu_identify", self._attach_steppers)

    def probe_prepare(self, hmove: Any) -> None:
        """Before each move towards the bed: the stream runs, and the board knows what to wait for."""
        super().probe_prepare(hmove)
        self._approach = self.coil.chip.stream.gather()
        endstop = self.mcu_endstop
        if self.tap is not None:
            self.tap.arm(endstop)
            return
        curve = self.coil.require_curve()
        code = self.coil.chip.code_of(self.coil.expected_hz(curve.hz(self.descend_mm)))
        endstop.filter.send([], Scale())
        endstop.set_trigger("gt", code, (1, CODE_MAX))

    def probe_finish(self, hmove: Any) -> None:
        if self._approach is not None:
            self._approach.end()
            self._approach = None
        super().probe_finish(hmove)

    def home_wait(self, home_end_time: float) -> float:
        """The time at which the height was descend_z: a line through the heights of the way down."""
        trigger_time = super().home_wait(home_end_time)
        if (
            not trigger_time
            or self.tap is not None
            or self._approach is None
            or self.coil.chip.mcu.is_fileoutput()
        ):
            return trigger_time
        self._approach.wait_until(trigger_time - 1.5 / RATE_HZ)
        return self._crossing(trigger_time, self._approach.between(trigger_time - APPROACH_S, trigger_time))

    def _crossing(self, trigger_time: float, samples: Sequence[Sample]) -> float:
        heights = [(time - trigger_time, self.coil.height_mm(hz)) for time, hz in samples]
        near = [(t, h - self.descend_mm) for t, h in heights if abs(h - self.descend_mm) < APPROACH_MM]
        if len(near) < APPROACH_MIN:
            return trigger_time
        slope, start = statistics.linear_regression([t for t, _ in near], [h for _, h in near])
        found = -start / slope if slope < 0.0 else 0.0
        return trigger_time + found if abs(found) < APPROACH_S else trigger_time


class EddyProbe(PrinterProbe):
    """Printer object 'probe' of [probe_eddy_current NAME], and its sessions of scans."""

    def __init__(self, config: ConfigWrapper, coil: Coil) -> None:
        self.coil = coil
        super().__init__(config, CoilSwitch(config, coil, self._read_height(config)))
        self.tap_threshold = config.getfloat("tap_threshold", None, above=0.0)
        self.tap_z_offset = config.getfloat("tap_z_offset", 0.0)
        self.tap_speed = config.getfloat("tap_speed", 3.0, above=0.0)
        self.last_tap_slope = 0.0
        self._is_tap = False  # the last probing
        self._last_bed: float | None = None  # of the last probing, since z was homed
        self.printer.register_event_handler("homing:home_rails_begin", self._forget_bed)
        self.printer.register_event_handler("stepper_enable:motor_off", self._forget_bed)
        self._gathering: Gathering | None = None
        self._passed: list[tuple[list[float], list[float]]] = []  # place; print times from, to

    def _forget_bed(self, *args: Any) -> None:
        self._last_bed = None

    @staticmethod
    def _read_height(config: ConfigWrapper) -> float:
        if config.get("descend_z", None) is None:
            older = config.getfloat("z_offset", None, above=0.0)  # the option's name until 2026
            if older is not None:
                return older
        return config.getfloat("descend_z", above=0.0)

    def _method(self, gcmd: GCodeCommand) -> str:
        method = gcmd.get("METHOD", "automatic").lower()
        if method not in METHODS:
            raise gcmd.error(f"METHOD is '{method}'; it can be {', '.join(METHODS)}")
        return method

    def run_probe(self, gcmd: GCodeCommand) -> list[float]:
        """Probe here, or note a point of a scan; x, y of the nozzle and its height at the trigger."""
        method = self._method(gcmd)
        self._is_tap = method == "tap"
        if method in ("scan", "rapid_scan"):
            if self._gathering is not None:
                return self._note_point(method)
            return self._measure_here()
        if method == "tap":
            check_homed(self.printer)
            return self._tap_once(gcmd)
        return super().run_probe(gcmd)

    # -- automatic --

    def _touch(self, speed: float) -> list[float]:
        """Down to descend_z, then measure at rest."""
        toolhead = self.printer.lookup_object("toolhead")
        status = check_homed(self.printer)
        self._require_height(toolhead)
        target = toolhead.get_position()
        target[2] = status["axis_minimum"][2]
        self.mcu_probe.measures_at_rest = True
        try:
            self.mcu_probe.probing_move(target, speed)
        finally:
            self.mcu_probe.measures_at_rest = False
        place = self._place_here(waits=False)  # the trigger has stopped it
        place[2] = self._corrected(place)
        self.printer.lookup_object("gcode").respond_info(
            f"probe at {place[0]:.3f},{place[1]:.3f} is z={place[2]:.6f}"
        )
        return place

    def _require_height(self, toolhead: Any) -> None:
        """A frequency that is passed already would stop the head at once. Lifts it where it has just probed."""
        place = toolhead.get_position()
        if self._last_bed is not None and place[2] > self._last_bed + self.offsets.z + SURE_MM:
            return
        gathering = self.coil.chip.stream.gather()
        try:
            height = self.coil.measure(gathering, 0.5 * SETTLE_S)
        finally:
            gathering.end()
        needed = self.offsets.z + START_MARGIN_MM
        if height < needed and not self.coil.chip.mcu.is_fileoutput():
            lifted = place[2] + needed - height + START_MARGIN_MM
            toolhead.manual_move([None, None, lifted], self.sampling.lift_speed)

    def _place_here(self, waits: bool = True) -> list[float]:
        """x, y, and the height at which the nozzle would be descend_z above the bed."""
        toolhead = self.printer.lookup_object("toolhead")
        gathering = self.coil.chip.stream.gather()
        try:
            x, y, z = toolhead.get_position()[:3]
            height = self.coil.measure(gathering, waits=waits)
        finally:
            gathering.end()
        self._last_bed = z - height
        return [x, y, z - height + self.offsets.z]

    def _measure_here(self) -> list[float]:
        """METHOD=scan of a single probing."""
        check_homed(self.printer)
        place = self._place_here()
        self._require_range(place)
        place[2] = self._corrected(place)
        self.commands.note_result(place)
        self._results.append(place)
        return place

    def _require_range(self, place: Sequence[float]) -> None:
        z = self.printer.lookup_object("toolhead").get_position()[2]
        height, limit = z - place[2] + self.offsets.z, self.coil.require_curve().range_mm[1]
        if height > limit and not self.coil.chip.mcu.is_fileoutput():
            raise self.printer.command_error(
                f"The coil is too far from the bed to measure: the calibration ends at {limit:.2f} mm. Lower"
                " horizontal_move_z, or move down."
            )

    # -- tap --

    def get_offsets(self, gcmd: Any = None) -> ProbeOffsets:
        """A tap is at the nozzle; without a command: those of the last probing."""
        is_tap = self._is_tap if gcmd is None else self._method(gcmd) == "tap"
        return ProbeOffsets(0.0, 0.0, self.offsets.z) if is_tap else self.offsets

    def _tap_once(self, gcmd: GCodeCommand) -> list[float]:
        place = self.run_tap(gcmd, gcmd.get_float("TAP_THRESHOLD", self.tap_threshold, above=0.0))
        coil_offsets, self.offsets = self.offsets, self.get_offsets(gcmd)
        try:
            place[2] = self._corrected(place)
            self.commands.note_result(place)
        finally:
            self.offsets = coil_offsets
        self._results.append(place)
        return place

    def run_tap(self, gcmd: GCodeCommand, threshold: float | None) -> list[float]:
        """Touch the bed; the result is at descend_z as of the other methods."""
        if threshold is None:
            raise gcmd.error(
                f"METHOD=tap needs tap_threshold in [{self.name}]: run PROBE_EDDY_CURRENT_TAP_CALIBRATE TAP=guess"
            )
        tap = Tap(self.coil, self.tap_speed, threshold)
        self.mcu_probe.tap = tap
        try:
            place = tap.run(self.mcu_probe)
        finally:
            self.mcu_probe.tap = None
        self.last_tap_slope = tap.slope_hz_mm
        place[2] += self.offsets.z - self.tap_z_offset
        gcmd.respond_info(
            f"probe at {place[0]:.3f},{place[1]:.3f} is z={place[2]:.6f} (tap, slope {tap.slope_hz_mm:.0f} Hz/mm)"
        )
        return place

    # -- sessions --

    def start_probe_session(self, gcmd: GCodeCommand) -> EddyProbe:
        if self._method(gcmd) in ("scan", "rapid_scan"):
            check_homed(self.printer)
            self.coil.require_curve()
            self._results, self._passed = [], []
            self._gathering = self.coil.chip.stream.gather()
            return self
        super().start_probe_session(gcmd)
        return self

    def _note_point(self, method: str) -> list[float]:
        """The move queued last ends here; scan rests a while."""
        toolhead = self.printer.lookup_object("toolhead")
        place = toolhead.get_position()[:3]
        times: list[float] = []
        if method == "scan":
            start = toolhead.get_last_move_time()
            toolhead.dwell(SETTLE_S + MEASURE_S)
            times += [start + SETTLE_S, start + SETTLE_S + MEASURE_S]
        else:
            toolhead.register_lookahead_callback(lambda t: times.extend((t - 0.5 * PASS_S, t + 0.5 * PASS_S)))
        self._passed.append((place, times))
        return place

    def pull_probed_results(self) -> list[list[float]]:
        if self._gathering is None:
            return super().pull_probed_results()
        passed, self._passed = self._passed, []
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.dwell(PASS_S)
        toolhead.get_last_move_time()
        results = []
        for place, times in passed:
            self._gathering.wait_until(times[1])
            if self.coil.chip.mcu.is_fileoutput():
                height = self.coil.require_curve().range_mm[0]
            else:
                height = self.coil.height_mm(self.coil.mean_hz(self._gathering.between(times[0], times[1])))
            result = [place[0], place[1], place[2] - height + self.offsets.z]
            result[2] = self._corrected(result)
            results.append(result)
        if results:
            self.commands.note_result(results[-1])
        return results

    def end_probe_session(self) -> None:
        if self._gathering is not None:
            self._gathering.end()
            self._gathering = None
            return
        super().end_probe_session()

    def _end_series(self) -> None:
        """A command has failed."""
        if self._gathering is not None:
            self._gathering.end()
            self._gathering = None
        super()._end_series()
