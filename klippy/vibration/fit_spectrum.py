"""From the samples of accelerometers to power spectra, and both as CSV files (the formats of Klipper's tools).

    raw data      #time,accel_x,accel_y,accel_z                   s, mm/s^2
    resonances    freq,psd_x,psd_y,psd_z,psd_xyz[,SHAPER(Hz) ...]  Hz, (mm/s^2)^2/Hz, share of vibration left

The spectrum is that of Welch 1967: Hann windows of WINDOW_S that overlap by half, each without its mean, averaged. It
needs numpy, so it runs in a process of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

Array = np.ndarray
WINDOW_S = 0.5  # 2 Hz of resolution
FREQUENCY_MAX_HZ = 200.0
MIN_SAMPLES = 64
COLUMNS = ("psd_x", "psd_y", "psd_z", "psd_xyz")


class DataError(Exception):
    """A file that cannot be used; the text is for people."""


@dataclass(frozen=True)
class Spectrum:
    """Power densities of x, y, z and their sum, as rows of `psd`."""

    frequency_hz: Array
    psd: Array
    shapers: dict[str, Array] = field(default_factory=dict)


def welch(values: Array, rate_hz: float, window_s: float = WINDOW_S) -> tuple[Array, Array]:
    """Frequencies and one-sided power density along the last axis."""
    count = values.shape[-1]
    size = min(2 ** int(np.ceil(np.log2(max(2.0, rate_hz * window_s)))), count)
    step = size - size // 2
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(size) / size)
    total = np.zeros((*values.shape[:-1], size // 2 + 1))
    starts = range(0, count - size + 1, step)
    for start in starts:
        part = values[..., start : start + size]
        part = (part - part.mean(axis=-1, keepdims=True)) * window
        total += np.abs(np.fft.rfft(part)) ** 2
    density = total / (len(starts) * rate_hz * (window**2).sum())
    density[..., 1 : size // 2 + size % 2] *= 2.0
    return np.fft.rfftfreq(size, 1.0 / rate_hz), density


def read(path: Path) -> Spectrum | Array:
    """A spectrum, or raw samples: columns time, x, y, z. Raises DataError."""
    try:
        with path.open() as stream:
            header = stream.readline().strip().lstrip("#").split(",")
            rows = np.loadtxt(stream, delimiter=",", ndmin=2)
    except (OSError, ValueError) as e:
        raise DataError(f"{path} cannot be read: {e}") from None
    if header[0] == "time" and rows.shape[1] == 4:
        if len(rows) < MIN_SAMPLES:
            raise DataError(f"{path} has {len(rows)} samples; a spectrum needs {MIN_SAMPLES}.")
        return rows
    if header[0] == "freq" and rows.shape[0] and rows.shape[1] == len(header) >= 5:
        extra = {name: rows[:, 5 + i] for i, name in enumerate(header[5:])}
        return Spectrum(rows[:, 0], rows[:, 1:5].T, extra)
    raise DataError(
        f"{path} is neither raw data (#time,accel_x,accel_y,accel_z) nor resonances (freq,psd_x,psd_y,psd_z,psd_xyz)."
    )


def of_samples(rows: Array) -> Spectrum:
    """The spectrum of raw samples."""
    rate_hz = (len(rows) - 1) / (rows[-1, 0] - rows[0, 0])
    frequency, psd = welch(rows[:, 1:].T, rate_hz)
    kept = frequency <= FREQUENCY_MAX_HZ
    return Spectrum(frequency[kept], np.vstack([psd, psd.sum(axis=0)])[:, kept])


def read_spectrum(paths: Sequence[Path]) -> Spectrum:
    """The mean spectrum of files; all on the frequencies of the first."""
    found = [data if isinstance(data, Spectrum) else of_samples(data) for data in map(read, paths)]
    first = found[0].frequency_hz
    rows = [[np.interp(first, s.frequency_hz, row) for row in s.psd] for s in found]
    return Spectrum(first, np.mean(rows, axis=0), found[0].shapers)


def write_spectrum(path: Path, spectrum: Spectrum) -> None:
    names = ["freq", *COLUMNS, *spectrum.shapers]
    with path.open("w") as stream:
        stream.write(",".join(names) + "\n")
        for i, frequency in enumerate(spectrum.frequency_hz):
            row = [f"{frequency:.1f}", *(f"{value:.3e}" for value in spectrum.psd[:, i])]
            stream.write(",".join([*row, *(f"{left[i]:.3f}" for left in spectrum.shapers.values())]) + "\n")
