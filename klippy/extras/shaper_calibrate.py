"""Fitting a shaper to samples of an accelerometer, for plugins that draw or judge by themselves.

The work is done by vibration/fit_shaper.py, in the caller's process. SHAPER_CALIBRATE does not come here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vibration import fit_shaper
from vibration.fit_spectrum import MIN_SAMPLES, Array, Spectrum, of_samples
from vibration.shapers import parse

AUTOTUNE_SHAPERS = list(fit_shaper.AUTOTUNED)
MAX_FREQ_HZ = fit_shaper.MAX_HZ


@dataclass
class CalibrationData:
    """Power densities by frequency, Hz."""

    name: str
    freq_bins: Array
    psd_sum: Array
    psd_x: Array
    psd_y: Array
    psd_z: Array
    is_normalized: bool = False

    def _rows(self) -> list[Array]:
        return [self.psd_x, self.psd_y, self.psd_z, self.psd_sum]

    def set_numpy(self, numpy: Any) -> None:
        """Plugins hand over numpy, which is here already."""

    def add_data(self, other: CalibrationData) -> None:
        """The mean of both."""
        rows = [np.interp(self.freq_bins, other.freq_bins, row) for row in other._rows()]
        self.psd_x, self.psd_y, self.psd_z, self.psd_sum = (
            0.5 * (own + row) for own, row in zip(self._rows(), rows, strict=True)
        )

    def normalize_to_frequencies(self) -> None:
        """Divide by the frequency: the excitation's acceleration grows with it."""
        if not self.is_normalized:
            share = 1.0 / np.maximum(self.freq_bins, fit_shaper.MIN_HZ)
            self.psd_x, self.psd_y, self.psd_z, self.psd_sum = (row * share for row in self._rows())
            self.is_normalized = True

    def get_psd(self, axis: str = "all") -> Array:
        return dict(zip(("x", "y", "z", "all"), self._rows(), strict=True))[axis]

    def spectrum(self) -> Spectrum:
        """As measured."""
        scale = np.maximum(self.freq_bins, fit_shaper.MIN_HZ) if self.is_normalized else 1.0
        return Spectrum(self.freq_bins, np.vstack(self._rows()) * scale)


class CalibrationResult(NamedTuple):
    """A shaper at its best frequency; vals: share of vibration left at each of freq_bins."""

    name: str
    freq: float
    freq_bins: Array
    vals: Array
    vibrs: float
    smoothing: float
    score: float
    max_accel: float


class ShaperCalibrate:
    """The fits."""

    def __init__(self, printer: Any = None) -> None:
        self.printer = printer
        self.numpy = np
        self.error = printer.command_error if printer is not None else ValueError

    def background_process_exec(self, method: Callable[..., Any], args: Sequence[Any]) -> Any:
        """method(*args); plugins with long work have processes of their own."""
        return method(*args)

    def process_accelerometer_data(self, name: str, data: Any) -> CalibrationData | None:
        """The spectrum of samples (rows of time, x, y, z) or of a recording; None if there are too few."""
        samples = np.asarray(data.get_samples() if hasattr(data, "get_samples") else data)
        if len(samples) < MIN_SAMPLES:
            return None
        spectrum = of_samples(samples)
        x, y, z, total = spectrum.psd
        return CalibrationData(name, spectrum.frequency_hz, total, x, y, z)

    def fit_shaper(
        self,
        shaper_cfg: Any,
        calibration_data: CalibrationData,
        max_smoothing: float | None = None,
        damping_ratio: float | None = None,
        scv: float | None = None,
    ) -> CalibrationResult | None:
        """The best of one type, by name or as in shaper_defs; None if none keeps the smoothing."""
        shaper = parse(getattr(shaper_cfg, "name", shaper_cfg))
        design = damping_ratio or fit_shaper.DAMPING_RATIO
        corner = fit_shaper.CORNER_SPEED_MM_S if scv is None else scv
        found = fit_shaper.fit_type(shaper, calibration_data.spectrum(), max_smoothing, corner, design)
        if found is None:
            return None
        bins = calibration_data.freq_bins
        left = fit_shaper.vibration_left(
            shaper, np.array([found.frequency_hz]), bins, fit_shaper.DAMPING_RATIO, design
        )
        score = found.smoothing_mm * (found.vibration + fit_shaper.VIBRATION_WEIGHT)
        return CalibrationResult(
            found.shaper, found.frequency_hz, bins, left[0], found.vibration, found.smoothing_mm, score,
            found.max_accel_mm_s2,
        )  # fmt: skip

    def find_best_shaper(
        self,
        calibration_data: CalibrationData,
        shapers: Sequence[Any] | None = None,
        damping_ratio: float | None = None,
        scv: float | None = None,
        shaper_freqs: Any = None,
        max_smoothing: float | None = None,
        test_damping_ratios: Any = None,
        max_freq: float | None = None,
        logger: Callable[[str], Any] | None = None,
    ) -> tuple[CalibrationResult, list[CalibrationResult]]:
        """(the best, the best of each type). Frequencies and damping ratios to try are those of SHAPER_CALIBRATE."""
        if shaper_freqs is not None or test_damping_ratios is not None:
            raise self.error("find_best_shaper: shaper_freqs and test_damping_ratios cannot be chosen here")
        fits = (
            self.fit_shaper(name, calibration_data, max_smoothing, damping_ratio, scv)
            for name in shapers or AUTOTUNE_SHAPERS
        )
        found = [fit for fit in fits if fit is not None]
        if not found:
            raise self.error(f"No shaper keeps the smoothing to {max_smoothing} mm. Allow more.")
        for fit in found if logger is not None else ():
            assert logger is not None
            logger(
                f"Fitted shaper '{fit.name}' frequency = {fit.freq:.1f} Hz (vibrations = {100.0 * fit.vibrs:.1f}%, "
                f"smoothing ~= {fit.smoothing:.3f}), suggested max_accel <= {fit.max_accel:.0f} mm/sec^2"
            )
        return min(found, key=lambda fit: fit.score), found

    def save_params(self, configfile: Any, axis: str, shaper_name: str, shaper_freq: float) -> None:
        """For SAVE_CONFIG; axis xy: both."""
        for letter in axis:
            configfile.set("input_shaper", f"shaper_type_{letter}", shaper_name)
            configfile.set("input_shaper", f"shaper_freq_{letter}", f"{shaper_freq:.1f}")
