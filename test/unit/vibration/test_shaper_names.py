"""Shaper fits by the names that plugins use give what SHAPER_CALIBRATE gives."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

from extras import shaper_defs
from extras.shaper_calibrate import CalibrationData, ShaperCalibrate
from vibration import fit_shaper
from vibration.fit_spectrum import of_samples

RATE_HZ = 3200.0


def samples() -> np.ndarray:
    """A frame of 47 Hz and damping 0.06, shaken by noise."""
    step = 1.0 / RATE_HZ
    w, z = 2.0 * np.pi * 47.0, 0.06
    shake = np.random.default_rng(3).normal(size=30000) * 1000.0
    place = speed = 0.0
    rows = []
    for n, force in enumerate(shake):
        accel = force - 2.0 * z * w * speed - w * w * place
        speed += accel * step
        place += speed * step
        rows.append((n * step, accel, 0.02 * accel, 0.01 * force))
    return np.array(rows)


@pytest.mark.parametrize("normalized", [False, True])
def test_the_best_shaper_is_that_of_the_command(normalized: bool) -> None:
    rows = samples()
    calibrate = ShaperCalibrate()
    data = calibrate.process_accelerometer_data("x", rows)
    assert data is not None and next(iter(inspect.signature(CalibrationData).parameters)) == "name"
    if normalized:
        data.normalize_to_frequencies()
        data.normalize_to_frequencies()
    lines: list[str] = []
    best, found = calibrate.find_best_shaper(data, max_smoothing=0.3, scv=5.0, logger=lines.append)
    report, _ = fit_shaper.calibrate(of_samples(rows), max_smoothing=0.3)
    assert (best.name, best.freq) == (report["best"]["shaper"], report["best"]["frequency_hz"])
    assert [fit.name for fit in found] == [row["shaper"] for row in report["shapers"]]
    assert [fit.max_accel for fit in found] == pytest.approx(
        [row["max_accel_mm_s2"] for row in report["shapers"]]
    )
    assert best.vals.shape == data.freq_bins.shape and len(lines) == len(found)
    # little is left where the frame swings, much far from it
    assert (
        best.vals[np.argmin(abs(data.freq_bins - best.freq))]
        < 0.2
        < best.vals[np.argmin(abs(data.freq_bins - 5))]
    )


def test_too_few_samples_have_no_spectrum_and_nothing_fits_no_smoothing() -> None:
    calibrate = ShaperCalibrate()
    assert calibrate.process_accelerometer_data("x", samples()[:20]) is None
    data = calibrate.process_accelerometer_data("x", samples())
    with pytest.raises(ValueError, match=r"No shaper keeps the smoothing to 0\.001 mm"):
        calibrate.find_best_shaper(data, max_smoothing=0.001)
    with pytest.raises(ValueError, match="cannot be chosen here"):
        calibrate.find_best_shaper(data, shaper_freqs=[40.0])


def test_the_types_have_impulses_by_frequency_and_damping() -> None:
    table = {cfg.name: cfg for cfg in shaper_defs.INPUT_SHAPERS}
    amplitudes, times = table["zv"].init_func(50.0, 0.0)
    assert amplitudes == pytest.approx([0.5, 0.5]) and times == pytest.approx([0.0, 0.01])
    assert set(shaper_defs.AUTOTUNE_SHAPERS) <= set(table)
    assert shaper_defs.get_none_shaper() == ([], [])
