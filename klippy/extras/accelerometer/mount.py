"""The vibration witness of [nozzle_monitor]: an accelerometer on the extruder's mount.

accelerometer ── messages ──► BandMeter ── windows ──┐
steppers: where each was at a window's ends ─────────┴─► flow, speeds ──► vibration/mount_witness.py
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from roles import Printer
from vibration import mount_witness
from vibration.band_meter import BandMeter, SampleFormat, design

WINDOW_S = 0.1
PERIOD_S = 1.0  # between looks at the samples
SETTLE_LAGS = 6.0  # of the mount, until the filters have forgotten a gap
RATE_CHANGE = 0.002  # of the chip's clock, until the filters are designed anew
GRAVITY_M_S2 = 9.80665
UPRIGHT_MIN = 0.7  # of gravity along z
SETTLED_RATE_S = 3.0  # until the chip's clock is known
CLIPPED_MAX = (
    0.02  # share of samples at the end of the range, or far from the one before: a knock may do that
)
SILENT_BATCHES = 2  # without a sample
FROZEN_SAMPLES = 200
UP_S = 3.0  # mean of the acceleration
START_S = 1.0  # after ready: clients are connected and see what is wrong
RATE_MIN = 2.5  # samples a second over the end of the band
HARMONICS = (1, 2, 3)  # of a motor's steps
UNPLUGGED = "unplugged: it gives no samples. Check its power and its wires"
SPEED_CHANGE_MAX_MM_S = 30.0  # of a motor, from a window to the next: more shakes the whole machine


@dataclass(frozen=True, slots=True)
class Motion:
    """Steps of each motor and filament fed at a window's end."""

    time_s: float
    steps: tuple[int, ...]
    fed_mm3: float


class SeenWindow(NamedTuple):
    """What mount_band.c said of a window."""

    first: int
    power: float
    clipped: int
    same: int
    failures: int
    settled: int
    mean: tuple[float, float, float]


class MountVibration:
    """Windows of one accelerometer to the witness; what is wrong with the sensor is said once."""

    def __init__(
        self,
        printer: Printer,
        section: str,
        axis: int,
        parameters: mount_witness.MountParameters,
        notches: Sequence[float],
        report: Callable[[str], None],
    ) -> None:
        self.printer = printer
        self.parameters = parameters
        self.state = mount_witness.start(parameters)
        self.fault: str | None = None
        self.on_step: Callable[[], None] = lambda: None
        self.temp_c: Callable[[], float] = lambda: math.nan
        self.fed_mm3: Callable[[float], float] = lambda print_time: 0.0
        self.recording: list[mount_witness.MountWindow] | None = None
        self.axis = axis
        self._section, self._notches, self._report = section, notches, report
        self.sensor: Any = None
        self._meter: Any = None
        self._rate_hz = 0.0
        self._motors: list[Any] = []
        self._speeds: list[float] = []  # of the window before, mm/s
        self._waiting: list[SeenWindow] = []
        self._bands: list[tuple[float, float]] = []  # steps a second that shake the mount in its band
        self._before: Motion | None = None
        self._seen_s = 0.0
        self._up = [0.0, 0.0, 0.0]
        self._silent = 0

    def connect(self, where: str) -> None:
        """Raises the printer's config_error if there is no such accelerometer."""
        self.sensor = self.printer.lookup_object(self._section, None)
        if not hasattr(self.sensor, "add_raw_client"):
            raise self.printer.config_error(
                f"Option 'accel_chip' in section 'nozzle_monitor' ({where}): '{self._section}' is not the section of an"
                " accelerometer, such as adxl345."
            )
        rate, highest = self.sensor.rate, self.parameters.frequency_hz + self.parameters.width_hz
        if rate < RATE_MIN * highest:
            raise self.printer.config_error(
                f"Section 'nozzle_monitor' ({where}): [{self._section}] takes {rate} samples a second; a mount of"
                f" {self.parameters.frequency_hz:g} Hz needs rate: {RATE_MIN * highest:.0f} or more."
            )

    def start(self) -> None:
        """The printer is ready."""
        kinematics = self.printer.lookup_object("toolhead").get_kinematics()
        self._motors = kinematics.get_steppers()
        reactor = self.printer.get_reactor()
        reactor.register_callback(self._begin, reactor.monotonic() + START_S)

    def _begin(self, eventtime: float) -> None:
        chip, p = self.sensor.chip, self.parameters
        weight = [0.0, 0.0, 0.0]
        along = self.sensor.axes[self.axis]
        weight[abs(along) - 1] = math.copysign(chip.mm_s2_per_count * 1e-3, along)
        clip = int(0.995 * chip.range_g * GRAVITY_M_S2 * 1e3 / chip.mm_s2_per_count)
        format_ = SampleFormat(
            chip.sample_bytes, chip.byte_order == "big", clip, (weight[0], weight[1], weight[2])
        )
        rate = float(self.sensor.rate)
        self._meter = BandMeter(
            format_, round(WINDOW_S * rate), round((SETTLE_LAGS * p.lag_s + SETTLED_RATE_S) * rate)
        )
        self._design(rate)
        try:
            self.sensor.add_raw_client(self._take_samples, self._on_batch, PERIOD_S)
        except self.printer.command_error as e:
            self._fail(f"no answer: {e}")

    def _design(self, rate_hz: float) -> None:
        p = self.parameters
        self._rate_hz = rate_hz
        shaper = self.printer.lookup_object("input_shaper", None)
        frame = [axis.frequency_hz for axis in shaper.axes if axis.frequency_hz] if shaper is not None else []
        notches = [
            (hz, 0.2 * hz) for hz in [*self._notches, *frame] if abs(hz - p.frequency_hz) > 0.5 * p.width_hz
        ]
        self._meter.set_sections(design(p.frequency_hz, p.width_hz, notches[:6], rate_hz))
        wide_hz = 0.75 * p.width_hz
        self._bands = [
            ((p.frequency_hz - wide_hz) / times, (p.frequency_hz + wide_hz) / times) for times in HARMONICS
        ]

    def apply(self, parameters: mount_witness.MountParameters) -> None:
        """Another mount, from the next sample on."""
        self.parameters = parameters
        self.state = mount_witness.start(parameters)
        self._design(self._rate_hz)

    # --- samples ---

    def _take_samples(self, first: int, data: bytes) -> None:
        for w in self._meter.take(first, data):
            x, y, z = w.mean
            self._waiting.append(
                SeenWindow(w.first, w.power, w.clipped, w.same, w.failures, w.settled, (x, y, z))
            )

    def _on_batch(self, batch: dict[str, Any]) -> bool:
        windows, self._waiting = self._waiting, []
        self._silent = 0 if windows else self._silent + 1
        if not windows:
            if self._silent == SILENT_BATCHES and self.fault is None:
                self._fail(UNPLUGGED)
            return True
        rate_hz = self.sensor.rate_hz()
        if abs(rate_hz / self._rate_hz - 1.0) > RATE_CHANGE:
            self._design(rate_hz)
        samples = round(WINDOW_S * self.sensor.rate)
        self._look_up(
            [sum(means) / len(windows) for means in zip(*(w.mean for w in windows), strict=True)],
            len(windows),
        )
        fault = self._find_fault(windows, samples)
        if fault != self.fault:
            self._fail(fault) if fault else self._recover()
        if fault is None:
            begin_s = self.sensor.time_of(samples)
            for w in windows:
                self._add(begin_s + w.first / rate_hz, w.power if w.settled and not w.clipped else math.nan)
        return True

    def _find_fault(self, windows: Sequence[SeenWindow], samples: int) -> str | None:
        """Of a second or so."""
        if any(w.failures for w in windows):
            return UNPLUGGED
        if sum(w.clipped for w in windows) > CLIPPED_MAX * samples * len(windows):
            return "saturated: its samples reach the end of its range, or jump. Check that it is fixed, and its wires"
        if max(w.same for w in windows) >= FROZEN_SAMPLES:
            return "frozen: its samples do not change. Check its power and its wires"
        if self._seen_s >= UP_S and max(map(abs, self._up)) > 0.5 * GRAVITY_M_S2:
            along = max(range(3), key=lambda axis: abs(self._up[axis]))
            if along != 2 or self._up[2] < UPRIGHT_MIN * GRAVITY_M_S2:
                sign = "-" if self._up[along] < 0.0 else ""
                return f"wrongly oriented: gravity is seen along its {sign}{'xyz'[along]} instead of z. Check axes_map"
        return None

    def _fail(self, fault: str) -> None:
        self.fault = fault
        self.state.recent.clear()
        self.state.step = mount_witness.Step()
        self._report(
            f"Nozzle monitor: [{self._section}] {fault}. The mount's vibration is not judged, the heat of the melt is."
        )

    def _recover(self) -> None:
        self.fault = None
        logging.info("Nozzle monitor: [%s] works again", self._section)

    # --- windows ---

    def _add(self, end_s: float, power: float) -> None:
        """A window that ended at a print time."""
        steps = tuple([motor.get_past_mcu_position(end_s) for motor in self._motors])
        motion = Motion(end_s, steps, self.fed_mm3(end_s))
        before, self._before = self._before, motion
        if before is None or not 0.5 * WINDOW_S < end_s - before.time_s < 2.0 * WINDOW_S:
            return
        if math.isnan(power):
            return
        lasts_s = end_s - before.time_s
        speeds = [abs(b - a) / lasts_s for a, b in zip(before.steps, motion.steps, strict=True)]
        is_disturbed = self._accelerates(before, motion) or self._is_in_band(speeds)
        window = mount_witness.MountWindow(
            end_s, lasts_s, power, motion.fed_mm3 / lasts_s, self.temp_c(), is_disturbed, any(speeds)
        )
        if self.recording is not None:
            self.recording.append(window)
        if mount_witness.observe(self.parameters, self.state, window):
            self.on_step()

    def _is_in_band(self, speeds: Sequence[float]) -> bool:
        """Do a motor's steps fall in the mount's band?"""
        return any(low < speed < high for low, high in self._bands for speed in speeds if speed > 0.0)

    def _accelerates(self, before: Motion, motion: Motion) -> bool:
        """Does a motor's speed change much from the window before?"""
        last, lasts_s = self._speeds, motion.time_s - before.time_s
        self._speeds = [
            (b - a) * motor.get_step_dist() / lasts_s
            for a, b, motor in zip(before.steps, motion.steps, self._motors, strict=True)
        ]
        return any(abs(b - a) > SPEED_CHANGE_MAX_MM_S for a, b in zip(last, self._speeds, strict=False))

    def _look_up(self, mean: Sequence[float], windows: int) -> None:
        """Where is gravity? Motion is no acceleration in the mean of some seconds."""
        scale = self.sensor.chip.mm_s2_per_count * 1e-3
        lasts_s = windows * WINDOW_S
        self._seen_s += lasts_s
        share = min(1.0, lasts_s / min(self._seen_s, UP_S))
        for place, axis in enumerate(self.sensor.axes):
            self._up[place] += share * (math.copysign(scale, axis) * mean[abs(axis) - 1] - self._up[place])
