"""The resonance of a mount from measurements at rest and with flow (klippy/vibration/fit_mount.py)."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from vibration import fit_mount
from vibration.fit_spectrum import DataError

RATE_HZ = 800.0


def measured(
    path: Path, f0: float, quality: float, amplitude: float, seed: int, seconds: float = 10.0
) -> Path:
    """Raw data in mm/s^2: gravity, white noise, and a ringing mount along z."""
    rng = np.random.default_rng(seed)
    count = int(seconds * RATE_HZ)
    pole = math.exp(-math.pi * f0 / quality / RATE_HZ) * np.exp(2j * math.pi * f0 / RATE_HZ)
    top, bottom = [1.0, -2.0, 1.0], np.poly([pole, pole.conjugate()]).real
    ring = signal.lfilter(top, bottom, rng.standard_normal(count + 4000))[4000:]
    _, response = signal.freqz(top, bottom, worN=1 << 15)
    ring *= amplitude / math.sqrt(2.0) / math.sqrt(np.mean(np.abs(response) ** 2))
    rows = rng.normal(0.0, 50.0, (count, 4))
    rows[:, 0] = np.arange(count) / RATE_HZ
    rows[:, 3] += 9806.65 + 1e3 * ring
    np.savetxt(path, rows, delimiter=",", fmt="%.6f", header="time,accel_x,accel_y,accel_z", comments="#")
    return path


@pytest.mark.parametrize(
    ("f0", "quality", "seconds"), [(200.0, 20.0, 10.0), (16.0, 10.0, 60.0), (123.0, 30.0, 10.0)]
)
def test_frequency_and_quality_are_found(tmp_path: Path, f0: float, quality: float, seconds: float) -> None:
    rest = measured(tmp_path / "rest.csv", f0, quality, 0.0, 1, 5.0)
    flows = [
        measured(tmp_path / f"{n}.csv", f0, quality, a, n + 2, seconds) for n, a in enumerate((0.3, 0.5, 0.8))
    ]
    found = fit_mount.fit([rest, *flows], 2)
    assert found["frequency_hz"] == pytest.approx(f0, abs=max(0.3, 0.01 * f0))
    assert found["quality"] == pytest.approx(quality, rel=0.3)
    weak, middle, strong = found["amplitudes_m_s2"]
    sigma = 4.0 * math.hypot(*found["sigmas"][:2])
    assert sigma < 0.15
    assert [math.log(weak / middle), math.log(strong / middle)] == pytest.approx(
        [math.log(0.6), math.log(1.6)], abs=sigma
    )
    assert found["noise_m_s2"] < 0.2 * weak


def test_a_measurement_without_vibration_is_refused(tmp_path: Path) -> None:
    files = [measured(tmp_path / f"{n}.csv", 200.0, 20.0, 0.0, n, 5.0) for n in range(3)]
    with pytest.raises(DataError, match="flow adds no vibration"):
        fit_mount.fit(files, 2)
    empty = tmp_path / "empty.csv"
    empty.write_text("#time,accel_x,accel_y,accel_z\n0,1,2,3\n")
    with pytest.raises(DataError, match="a spectrum needs 64"):
        fit_mount.fit([empty, *files], 2)
