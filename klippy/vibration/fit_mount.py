"""The resonance of an extruder's mount from measurements at rest and at several flows: a process of its own.

    python -m vibration.fit_mount --axis z REST.csv FLOW.csv ...  ->  JSON

The power density with flow is that at rest and that of a resonance which noise drives:

    S(f) = rest(f) + s f^4/((f0^2 - f^2)^2 + (f f0/Q)^2)

f0 and Q are those of the greatest Whittle likelihood, sum(-ln S - P/S) over the frequencies about the peak (Whittle
1953). The amplitude at each flow is that behind the monitor's filters. It needs numpy.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .band_meter import PEAKS, Section, design
from .fit_spectrum import Array, DataError, read, welch
from .mount_witness import MountParameters

WINDOW_S = 2.0
FREQUENCY_MIN_HZ = 8.0
PROMINENCE_MIN = 4.0  # of the peak over the density at rest
QUALITIES = np.geomspace(4.0, 80.0, 41)
M_PER_MM = 1e-3


def density(path: Path, axis: int) -> tuple[Array, Array, float]:
    """Frequencies, power density along an axis ((m/s^2)^2/Hz), samples a second."""
    rows = read(path)
    if not isinstance(rows, np.ndarray):
        raise DataError(f"{path} has no raw samples")
    rate_hz = (len(rows) - 1) / (rows[-1, 0] - rows[0, 0])
    hz, psd = welch(rows[:, 1 + axis] * M_PER_MM, rate_hz, WINDOW_S)
    return hz, psd, float(rate_hz)


def smooth(values: Array, bins: int) -> Array:
    """Mean over so many bins, fewer at the ends."""
    window = np.ones(bins)
    return np.convolve(values, window, mode="same") / np.convolve(np.ones_like(values), window, mode="same")


def resonance(hz: Array, f0: float, quality: float) -> Array:
    return hz**4 / ((f0**2 - hz**2) ** 2 + (hz * f0 / quality) ** 2)


def likelihood(hz: Array, psd: Array, rest: Array, f0: float, quality: float) -> float:
    """The greatest over s."""
    shape = resonance(hz, f0, quality)
    scale = max(1e-30, float((psd - rest).sum() / shape.sum()))
    for _ in range(20):
        model = rest + scale * shape
        scale *= float((psd * shape / model**2).sum() / (shape / model).sum())
    model = rest + scale * shape
    return float(-(np.log(model) + psd / model).sum())


def find_resonance(hz: Array, psd: Array, rest: Array) -> tuple[float, float]:
    """f0 and Q. Raises DataError if flow adds no peak."""
    added = smooth(psd - rest, 9)
    usable = (hz >= FREQUENCY_MIN_HZ) & (hz <= 0.9 * hz[-1])
    at = int(np.argmax(np.where(usable, added, -np.inf)))
    if added[at] < PROMINENCE_MIN * rest[at]:
        raise DataError(
            f"flow adds no vibration: the strongest, at {hz[at]:.0f} Hz, is hardly above that at rest"
        )
    centre = hz[at]
    near = (hz > 0.6 * centre) & (hz < 1.4 * centre) & usable
    step = max(0.2, 0.002 * centre)
    best = (-np.inf, centre, 10.0)
    for f0 in np.arange(0.9 * centre, 1.1 * centre, step):
        for quality in QUALITIES:
            best = max(best, (likelihood(hz[near], psd[near], rest[near], f0, quality), f0, quality))
    return float(best[1]), float(best[2])


def gain_square(sections: Sequence[Section], hz: Array, rate_hz: float) -> Array:
    """Of filters, at frequencies."""
    z = np.exp(-2j * np.pi * hz / rate_hz)
    response = np.ones_like(z)
    for b0, b1, b2, a1, a2 in sections:
        response *= (b0 + b1 * z + b2 * z**2) / (1.0 + a1 * z + a2 * z**2)
    return np.abs(response) ** 2


def fit(paths: Sequence[Path], axis: int) -> dict[str, Any]:
    """Of the measurement at rest and those with flow. Raises DataError."""
    hz, rest, rate_hz = density(paths[0], axis)
    flows = []
    for path in paths[1:]:
        at_hz, psd, _ = density(path, axis)
        flows.append(np.interp(hz, at_hz, psd))
    floor = smooth(rest, 33)
    f0, quality = find_resonance(hz, np.mean(flows, axis=0), floor)
    width_hz = MountParameters(frequency_hz=f0, quality=quality).width_hz
    band = gain_square(design(f0, width_hz, [], rate_hz)[:PEAKS], hz, rate_hz)
    powers = [float(((psd - floor) * band).sum() * (hz[1] - hz[0])) for psd in flows]
    return {
        "frequency_hz": f0,
        "quality": quality,
        "amplitudes_m_s2": [(2.0 * max(power, 0.0)) ** 0.5 for power in powers],
        "noise_m_s2": float((2.0 * (floor * band).sum() * (hz[1] - hz[0])) ** 0.5),
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
