"""The resonance of an extruder's mount from measurements at rest and at several flows: a process of its own.

    python -m vibration.fit_mount --axis z REST.csv FLOW.csv ...  ->  JSON

The power density with flow is that at rest and that of a resonance which noise drives:

    S(f) = rest(f) + s f^4/((f0^2 - f^2)^2 + (f f0/Q)^2)

f0, Q and each flow's s are those of the greatest Whittle likelihood, sum(-ln S - P/S) over the frequencies about the
peak (Whittle 1953). The variance of ln s is 1/(T int (s R/S)^2 df), with T the time and R the resonance: the slopes
beside the peak count as long as they stand out of the noise. The power behind the monitor's filters is in proportion to
s. It needs numpy.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .band_meter import PEAKS, Section, design
from .fit_spectrum import Array, DataError, read, welch
from .mount_witness import MountParameters

WINDOW_S = 2.0
FREQUENCY_MIN_HZ = 8.0
FREQUENCY_SHARE_MAX = 0.9  # of half the rate
PROMINENCE_MIN = 4.0  # of the peak over the density at rest
QUALITIES = np.geomspace(4.0, 80.0, 15)
NEAR_WIDTHS = 4.0  # of the resonance, to each side
M_PER_MM = 1e-3


@dataclass(frozen=True)
class Measured:
    """Frequencies, power density along an axis ((m/s^2)^2/Hz), samples a second, and for how long."""

    hz: Array
    psd: Array
    rate_hz: float
    lasts_s: float


def measured(path: Path, axis: int) -> Measured:
    """Of a file of raw samples. Raises DataError."""
    rows = read(path)
    if not isinstance(rows, np.ndarray):
        raise DataError(f"{path} has no raw samples")
    lasts_s = float(rows[-1, 0] - rows[0, 0])
    rate_hz = (len(rows) - 1) / lasts_s
    return Measured(*welch(rows[:, 1 + axis] * M_PER_MM, rate_hz, WINDOW_S), rate_hz, lasts_s)


def smooth(values: Array, bins: int) -> Array:
    """Mean over so many bins, fewer at the ends."""
    window = np.ones(bins)
    return np.convolve(values, window, mode="same") / np.convolve(np.ones_like(values), window, mode="same")


def resonance(hz: Array, f0: float, quality: float) -> Array:
    return hz**4 / ((f0**2 - hz**2) ** 2 + (hz * f0 / quality) ** 2)


def strength(psd: Array, rest: Array, shape: Array) -> float:
    """s of the greatest likelihood."""
    scale = max(1e-30, float((psd - rest).sum() / shape.sum()))
    for _ in range(20):
        model = rest + scale * shape
        scale *= float((psd * shape / model**2).sum() / (shape / model).sum())
    return scale


def likelihood(hz: Array, psd: Array, rest: Array, f0: float, quality: float) -> float:
    """The greatest over s."""
    shape = resonance(hz, f0, quality)
    model = rest + strength(psd, rest, shape) * shape
    return float(-(np.log(model) + psd / model).sum())


def about(hz: Array, centre_hz: float) -> Array:
    """The frequencies that a likelihood is summed over."""
    return (hz > 0.6 * centre_hz) & (hz < 1.4 * centre_hz) & (hz <= FREQUENCY_SHARE_MAX * hz[-1])


def find_resonance(hz: Array, psd: Array, rest: Array) -> tuple[float, float]:
    """f0 and Q. Raises DataError if flow adds no peak."""
    added = smooth(psd - rest, 9)
    usable = (hz >= FREQUENCY_MIN_HZ) & (hz <= FREQUENCY_SHARE_MAX * hz[-1])
    at = int(np.argmax(np.where(usable, added, -np.inf)))
    if added[at] < PROMINENCE_MIN * rest[at]:
        raise DataError(
            f"flow adds no vibration: the strongest, at {hz[at]:.0f} Hz, is hardly above that at rest"
        )
    f0 = float(hz[at])
    return search(hz, psd, rest, about(hz, f0), np.linspace(0.9, 1.1, 41) * f0, QUALITIES)


def search(
    hz: Array, psd: Array, rest: Array, near: Array, frequencies: Array, qualities: Array
) -> tuple[float, float]:
    """f0 and Q of the greatest likelihood."""
    found = [
        (likelihood(hz[near], psd[near], rest[near], f0, quality), f0, quality)
        for f0 in frequencies
        for quality in qualities
    ]
    _, f0, quality = max(found)
    return float(f0), float(quality)


def refine(hz: Array, psd: Array, rest: Array, f0: float, quality: float) -> tuple[float, float]:
    """From the peak alone: farther away the sensor's own filter bends the spectrum."""
    near = about(hz, f0) & (np.abs(hz - f0) < NEAR_WIDTHS * f0 / quality)
    return search(
        hz, psd, rest, near, np.linspace(0.985, 1.015, 31) * f0, np.geomspace(0.7, 1.4, 25) * quality
    )


def gain_square(sections: Sequence[Section], hz: Array, rate_hz: float) -> Array:
    """Of filters, at frequencies."""
    z = np.exp(-2j * np.pi * hz / rate_hz)
    response = np.ones_like(z)
    for b0, b1, b2, a1, a2 in sections:
        response *= (b0 + b1 * z + b2 * z**2) / (1.0 + a1 * z + a2 * z**2)
    return np.abs(response) ** 2


def fit(paths: Sequence[Path], axis: int) -> dict[str, Any]:
    """Of the measurement at rest and those with flow. Raises DataError."""
    rest = measured(paths[0], axis)
    hz, floor = rest.hz, smooth(rest.psd, 33)
    flows = [measured(path, axis) for path in paths[1:]]
    psds = [np.interp(hz, flow.hz, flow.psd) for flow in flows]
    f0, quality = find_resonance(hz, np.mean(psds, axis=0), floor)
    near, bin_hz = about(hz, f0), hz[1] - hz[0]
    shape = resonance(hz[near], f0, quality)
    strengths = np.array([strength(psd[near], floor[near], shape) for psd in psds])
    alike = [psd / scale for psd, scale in zip(psds, strengths, strict=True)]
    f0, quality = refine(hz, np.mean(alike, axis=0), floor * np.mean(1.0 / strengths), f0, quality)
    shares = [scale * shape / (floor[near] + scale * shape) for scale in strengths]
    weights = np.array([f.lasts_s * bin_hz * (x**2).sum() for f, x in zip(flows, shares, strict=True)])
    width_hz = MountParameters(frequency_hz=f0, quality=quality).width_hz
    band = gain_square(design(f0, width_hz, [], rest.rate_hz)[:PEAKS], hz, rest.rate_hz)
    powers = np.array([((psd - floor) * band).sum() * bin_hz for psd in psds])
    power = float((weights * powers / strengths).sum() / weights.sum())  # of s = 1, behind the filters
    return {
        "frequency_hz": f0,
        "quality": quality,
        "amplitudes_m_s2": [float((2.0 * max(power, 0.0) * scale) ** 0.5) for scale in strengths],
        "sigmas": [float(0.5 * weight**-0.5) for weight in weights],  # of their logarithms
        "noise_m_s2": float((2.0 * (floor * band).sum() * bin_hz) ** 0.5),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--axis", choices="xyz", default="z")
    parser.add_argument("files", type=Path, nargs="+", metavar="CSV")
    options = parser.parse_args()
    try:
        print(json.dumps(fit(options.files, "xyz".index(options.axis))))
    except DataError as e:
        print(e, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
