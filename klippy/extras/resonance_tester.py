"""[resonance_tester]: TEST_RESONANCES, SHAPER_CALIBRATE, MEASURE_AXES_NOISE.

excitation (vibration/excitation.py) ─► motion queue ─► frame ─► accelerometer ─► raw file
raw files ─► vibration/fit_shaper.py, a process of its own ─► spectrum file, shaper ─► input_shaper, SAVE_CONFIG
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import chelper
import util
from configfile import ConfigWrapper
from gcode import GCodeCommand
from motionlimits import SPEED, Range
from roles import Printer
from vibration.excitation import Excitation, extent_mm, split_at_rest

from .accelerometer.commands import open_result, report_quality, result_name

HOST_FOLDER = Path(__file__).resolve().parents[1]
NOISE_S = 2.0
REST_S = 0.5  # before and after a test
CHUNK_S = 0.05
REPORT_HZ = 5.0
FIT_AXES = {"x": 0, "y": 1}
_LIMITS: dict[str, Range] = {
    "min_freq": {"minval": 1.0, "maxval": 200.0},
    "max_freq": {"minval": 1.0, "maxval": 300.0},
    "accel_per_hz": {"above": 0.0, "maxval": 1000.0},
    "hz_per_sec": {"minval": 0.1, "maxval": 2.0},
}


@dataclass(frozen=True, slots=True)
class TestAxis:
    """A direction in X and Y, of length 1."""

    __test__ = False  # not of pytest
    name: str
    direction: tuple[float, float]

    @property
    def fit_axis(self) -> int:
        """Row of the spectrum that has this direction."""
        return FIT_AXES.get(self.name, 3)


def parse_axis(gcmd: GCodeCommand, text: str) -> TestAxis:
    """'X', 'Y' or 'dx,dy'."""
    if text.lower() in FIT_AXES:
        name = text.lower()
        return TestAxis(name, (1.0, 0.0) if name == "x" else (0.0, 1.0))
    try:
        x, y = (float(word) for word in text.split(","))
        length = math.hypot(x, y)
        return TestAxis(f"axis={x:.3f},{y:.3f}", (x / length, y / length))
    except (ValueError, ZeroDivisionError):
        raise gcmd.error(f"AXIS='{text}' must be X, Y, or a direction such as 1,-1.") from None


class ResonanceTester:
    """Printer object 'resonance_tester'."""

    def __init__(
        self,
        printer: Printer,
        chips: dict[str, str],
        points: Sequence[Sequence[float]],
        excitation: Excitation,
        move_speed: float,
        max_smoothing: float | None,
    ) -> None:
        self.printer = printer
        self._chip_names = chips  # axis -> section
        self._points = points
        self._excitation = excitation
        self._move_speed = move_speed
        self._max_smoothing = max_smoothing
        self._sensors: dict[str, Any] = {}
        _ffi, self._lib = chelper.get_ffi()

    # --- what plugins read ---

    @property
    def probe_points(self) -> list[tuple[float, ...]]:
        return [tuple(point) for point in self._points]

    @property
    def accel_chip_names(self) -> list[tuple[str, str]]:
        """(axis or axes, section of the chip)."""
        names = list(self._chip_names.items())
        return [("xy", names[0][1])] if len(set(self._chip_names.values())) == 1 else names

    @property
    def generator(self) -> Any:
        e = self._excitation
        pulses = SimpleNamespace(
            min_freq=e.min_hz, max_freq=e.max_hz, accel_per_hz=e.accel_per_hz, hz_per_sec=e.hz_per_s
        )
        return SimpleNamespace(
            vibration_generator=pulses, sweeping_accel=e.sweeping_accel, sweeping_period=e.sweeping_period_s
        )

    # --- set-up ---

    def register(self) -> None:
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command(
            "MEASURE_AXES_NOISE",
            self.cmd_MEASURE_AXES_NOISE,
            desc="Measures noise of all enabled accelerometer chips",
        )
        gcode.register_command(
            "TEST_RESONANCES", self.cmd_TEST_RESONANCES, desc="Runs the resonance test for a specified axis"
        )
        gcode.register_command(
            "SHAPER_CALIBRATE",
            self.cmd_SHAPER_CALIBRATE,
            desc="Runs the resonance test and suggests input shaper parameters",
        )
        self.printer.register_event_handler("klippy:connect", self._handle_connect)

    def _handle_connect(self) -> None:
        for axis, name in self._chip_names.items():
            self._sensors[axis] = self._lookup_sensor(name, self.printer.config_error)

    def _lookup_sensor(self, name: str, error: Any) -> Any:
        sensor = self.printer.lookup_object(name.strip(), None)
        if not hasattr(sensor, "start_internal_client"):
            raise error(
                f"[resonance_tester]: '{name}' is not the section of an accelerometer, such as adxl345."
            )
        return sensor

    # --- motion ---

    def _excitation_of(self, gcmd: GCodeCommand) -> Excitation:
        e = self._excitation
        changed = replace(
            e,
            min_hz=gcmd.get_float("FREQ_START", e.min_hz, **_LIMITS["min_freq"]),
            max_hz=gcmd.get_float("FREQ_END", e.max_hz, **_LIMITS["max_freq"]),
            accel_per_hz=gcmd.get_float("ACCEL_PER_HZ", e.accel_per_hz, **_LIMITS["accel_per_hz"]),
            hz_per_s=gcmd.get_float("HZ_PER_SEC", e.hz_per_s, **_LIMITS["hz_per_sec"]),
        )
        if changed.max_hz <= changed.min_hz:
            raise gcmd.error(f"FREQ_END={changed.max_hz:g} must be above FREQ_START={changed.min_hz:g}.")
        return changed

    def _points_of(self, gcmd: GCodeCommand) -> Sequence[Sequence[float]]:
        text = gcmd.get("POINT", None)
        if text is None:
            return self._points
        try:
            point = [float(word) for word in text.split(",")]
        except ValueError:
            point = []
        if len(point) != 3:
            raise gcmd.error(f"POINT='{text}' must be x,y,z in mm.")
        return [point]

    def _check_room(
        self, gcmd: GCodeCommand, axis: TestAxis, point: Sequence[float], excitation: Excitation
    ) -> None:
        status = self.printer.lookup_object("toolhead").get_kinematics().get_status(0.0)
        reach = extent_mm(excitation)
        for i, letter in enumerate("XY"):
            low, high = status["axis_minimum"][i], status["axis_maximum"][i]
            way = abs(axis.direction[i]) * reach
            if way and not low + way <= point[i] <= high - way:
                raise gcmd.error(
                    f"The test goes {way:.1f} mm from {letter}={point[i]:g}, and the axis from {low:g} to {high:g} mm."
                    " Choose another probe point, or a lower sweeping_accel."
                )

    def _excite(self, gcmd: GCodeCommand, axis: TestAxis, excitation: Excitation) -> None:
        """From rest to rest, and back at the same place."""
        toolhead = self.printer.lookup_object("toolhead")
        dx, dy = axis.direction
        x, y, z = toolhead.get_position()[:3]
        place = speed = pending = 0.0
        next_report = 0.0
        time = toolhead.get_last_move_time()
        for duration, accel, hz in excitation.stretches():
            for part, start in split_at_rest(duration, speed, accel):
                end = start + accel * part
                sign = 1.0 if start + end >= 0.0 else -1.0
                is_faster = abs(end) > abs(start)
                self._lib.trapq_append(
                    toolhead.get_trapq(), time, part if is_faster else 0.0, 0.0, 0.0 if is_faster else part,
                    x + dx * place, y + dy * place, z, sign * dx, sign * dy, 0.0,
                    abs(start), max(abs(start), abs(end)), abs(accel),
                )  # fmt: skip
                place += 0.5 * (start + end) * part
                time += part
            speed += accel * duration
            pending += duration
            if pending >= CHUNK_S:
                toolhead.dwell(pending)
                pending = 0.0
            if hz >= next_report:
                gcmd.respond_info(f"Testing frequency {hz:.0f} Hz")
                next_report = hz + REPORT_HZ
        toolhead.dwell(pending)
        toolhead.flush_step_generation()

    def _test(
        self,
        gcmd: GCodeCommand,
        axis: TestAxis,
        point: Sequence[float],
        excitation: Excitation,
        sensors: Sequence[Any],
    ) -> list[Any]:
        """The recordings of one test at one point."""
        toolhead = self.printer.lookup_object("toolhead")
        self._check_room(gcmd, axis, point, excitation)
        half = 0.5 * excitation.sweep_mm
        start = [c - d * half for c, d in zip(point[:2], axis.direction, strict=True)]
        toolhead.manual_move([*start, point[2]], self._move_speed)
        toolhead.dwell(REST_S)
        toolhead.wait_moves()
        gcmd.respond_info(f"Testing axis {axis.name} at ({', '.join(f'{c:.1f}' for c in point)})")
        shaper = self.printer.lookup_object("input_shaper", None)
        is_shaped = bool(gcmd.get_int("INPUT_SHAPING", 0, minval=0, maxval=1))
        if shaper is not None and not is_shaped:
            shaper.disable_shaping()
        try:
            recordings = [sensor.start_internal_client() for sensor in sensors]
            self._excite(gcmd, axis, excitation)
            toolhead.dwell(REST_S)
            for recording in recordings:
                recording.finish_measurements()
        finally:
            if shaper is not None and not is_shaped:
                shaper.enable_shaping()
        for recording in recordings:
            report_quality(gcmd, recording)
            if not recording.has_valid_samples():
                raise gcmd.error(f"No accelerometer measurements found for [{recording.section}].")
        return recordings

    # --- results ---

    def _sensors_of(self, gcmd: GCodeCommand, axis: TestAxis) -> list[Any]:
        names = gcmd.get("CHIPS", None)
        if names is not None:
            return [self._lookup_sensor(name, gcmd.error) for name in names.split(",")]
        if axis.name in self._sensors:
            return [self._sensors[axis.name]]
        return list(dict.fromkeys(self._sensors.values()))

    def _measure(self, gcmd: GCodeCommand, axis: TestAxis, name: str) -> list[Path]:
        """Tests at all points; the raw files."""
        excitation = self._excitation_of(gcmd)
        sensors, points = self._sensors_of(gcmd, axis), self._points_of(gcmd)
        paths = []
        for point in points:
            for recording in self._test(gcmd, axis, point, excitation, sensors):
                words = ["raw_data", axis.name]
                if len(sensors) > 1 or gcmd.get("CHIPS", None) is not None:
                    words.append(recording.section.replace(" ", "-"))
                if len(points) > 1:
                    words.append("point=" + ",".join(f"{c:.3f}" for c in point))
                with open_result(gcmd, "_".join([*words, name]) + ".csv") as stream:
                    recording.write(stream)
                paths.append(Path(stream.name))
        return paths

    def _evaluate(
        self, gcmd: GCodeCommand, raw: Sequence[Path], out: str, options: Sequence[str]
    ) -> tuple[Any, str]:
        """What a process of its own finds in raw files, and the name of the file with the spectrum."""
        with open_result(gcmd, out) as stream:
            path = stream.name
        command = [sys.executable, "-m", "vibration.fit_shaper", *map(str, raw), "--out", path, *options]
        command = util.at_ordinary_priority(command)
        run = partial(subprocess.run, command, cwd=HOST_FOLDER, capture_output=True, text=True, check=False)
        done = self.printer.get_reactor().run_beside(run).wait()
        if isinstance(done, Exception) or done.returncode:
            why = (
                str(done)
                if isinstance(done, Exception)
                else (done.stderr.strip().splitlines() or ["no reason"])[-1]
            )
            raise gcmd.error(
                f"The measurement cannot be evaluated: {why}. Raw data: {', '.join(map(str, raw))}."
            )
        return json.loads(done.stdout), path

    def cmd_TEST_RESONANCES(self, gcmd: GCodeCommand) -> None:
        """TEST_RESONANCES AXIS= [OUTPUT=resonances,raw_data] [NAME=] [FREQ_START=] [FREQ_END=] ..."""
        axis, name = parse_axis(gcmd, gcmd.get("AXIS")), result_name(gcmd)
        outputs = [word.strip().lower() for word in gcmd.get("OUTPUT", "resonances").split(",")]
        if not outputs or not set(outputs) <= {"resonances", "raw_data"}:
            raise gcmd.error("OUTPUT must be resonances, raw_data, or both with a comma between.")
        raw = self._measure(gcmd, axis, name)
        if "resonances" in outputs:
            _, written = self._evaluate(gcmd, raw, f"resonances_{axis.name}_{name}.csv", [])
            gcmd.respond_info(f"Resonances data written to {written} file")
        for path in raw:
            if "raw_data" in outputs:
                gcmd.respond_info(f"Writing raw accelerometer data to {path} file")
            else:
                path.unlink(missing_ok=True)

    def cmd_SHAPER_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """SHAPER_CALIBRATE [AXIS=] [NAME=] [FREQ_START=] ... [MAX_SMOOTHING=]"""
        text, name = gcmd.get("AXIS", None), result_name(gcmd)
        axes = [parse_axis(gcmd, word) for word in ([text] if text else ["x", "y"])]
        if any(axis.name not in FIT_AXES for axis in axes):
            raise gcmd.error("SHAPER_CALIBRATE needs AXIS=X or AXIS=Y, or none for both.")
        smoothing = gcmd.get_float("MAX_SMOOTHING", self._max_smoothing, minval=0.05)
        corner_speed = self.printer.lookup_object("toolhead").square_corner_velocity
        for axis in axes:
            raw = self._measure(gcmd, axis, name)
            options = ["--axis", str(axis.fit_axis), "--corner-speed", str(corner_speed)]
            if smoothing is not None:
                options += ["--max-smoothing", str(smoothing)]
            found, path = self._evaluate(gcmd, raw, f"calibration_data_{axis.name}_{name}.csv", options)
            for each in raw:
                each.unlink(missing_ok=True)
            self._report(gcmd, axis.name, found, path)
        gcmd.respond_info(
            "The SAVE_CONFIG command will update the printer config file\nwith these parameters and "
            "restart the printer."
        )

    def _report(self, gcmd: GCodeCommand, axis: str, found: dict[str, Any], path: str) -> None:
        gcmd.respond_info(
            f"Resonance of axis {axis}: {found['resonance_hz']:.1f} Hz, damping ratio {found['damping_ratio']:.3f}"
        )
        for choice in found["shapers"]:
            gcmd.respond_info(
                f"Fitted shaper '{choice['shaper']}' frequency = {choice['frequency_hz']:.1f} Hz (vibrations ="
                f" {100.0 * choice['vibration']:.1f}%, smoothing ~= {choice['smoothing_mm']:.3f})\nTo avoid too much"
                f" smoothing with '{choice['shaper']}', suggested max_accel <= {choice['max_accel_mm_s2']:.0f} mm/sec^2"
            )
        best = found["best"]
        gcmd.respond_info(
            f"Recommended shaper_type_{axis} = {best['shaper']}, shaper_freq_{axis} = {best['frequency_hz']:.1f} Hz\n"
            f"Shaper calibration data written to {path} file"
        )
        configfile = self.printer.lookup_object("configfile")
        configfile.set("input_shaper", f"shaper_type_{axis}", best["shaper"])
        configfile.set("input_shaper", f"shaper_freq_{axis}", f"{best['frequency_hz']:.1f}")

    def cmd_MEASURE_AXES_NOISE(self, gcmd: GCodeCommand) -> None:
        """MEASURE_AXES_NOISE [MEAS_TIME=s]"""
        toolhead = self.printer.lookup_object("toolhead")
        duration = gcmd.get_float("MEAS_TIME", NOISE_S, above=0.0, maxval=60.0)
        names: dict[Any, str] = {}
        for axis, sensor in self._sensors.items():
            names[sensor] = names.get(sensor, "") + axis
        recordings = [(axis, sensor.start_internal_client()) for sensor, axis in names.items()]
        toolhead.dwell(duration)
        for axis, recording in recordings:
            recording.finish_measurements()
            report_quality(gcmd, recording)
            samples = recording.get_samples()
            if len(samples) < 2:
                raise gcmd.error(f"{axis}-axis accelerometer measured no data")
            columns = list(zip(*samples, strict=True))[1:]
            means = [sum(column) / len(column) for column in columns]
            noise = [
                math.sqrt(sum((v - mean) ** 2 for v in column) / len(column))
                for column, mean in zip(columns, means, strict=True)
            ]
            gcmd.respond_info(
                "Axes noise for {}-axis accelerometer: {:.6f} (x), {:.6f} (y), {:.6f} (z)".format(
                    axis, *noise
                )
            )


def load_config(config: ConfigWrapper) -> ResonanceTester:
    own = {axis: config.get(f"accel_chip_{axis}", None) for axis in "xy"}
    common = config.get("accel_chip", None)
    chips = {}
    for axis, name in own.items():
        if name is None and common is None:
            raise config.error(
                f"Section 'resonance_tester' ({config.where()}) needs accel_chip, or accel_chip_x and accel_chip_y."
            )
        chips[axis] = name or common or ""
    points = config.getlists("probe_points", seps=(",", "\n"), parser=float, count=3)
    min_hz = config.getfloat("min_freq", 5.0, **_LIMITS["min_freq"])
    excitation = Excitation(
        min_hz=min_hz,
        max_hz=config.getfloat("max_freq", 133.33, above=min_hz, maxval=300.0),
        accel_per_hz=config.getfloat("accel_per_hz", 60.0, **_LIMITS["accel_per_hz"]),
        hz_per_s=config.getfloat("hz_per_sec", 1.0, **_LIMITS["hz_per_sec"]),
        sweeping_accel=config.getfloat("sweeping_accel", 400.0, above=0.0, maxval=10000.0),
        sweeping_period_s=config.getfloat("sweeping_period", 1.2, minval=0.0, maxval=60.0),
    )
    speed = config.getfloat("move_speed", 50.0, **SPEED)
    max_smoothing = config.getfloat("max_smoothing", None, minval=0.05)
    tester = ResonanceTester(config.get_printer(), chips, points, excitation, speed, max_smoothing)
    tester.register()
    return tester
