"""The shaper for a measured spectrum: python -m vibration.fit_shaper, in a process of its own, prints JSON.

A shaper of impulses A_i at t_i leaves of an oscillation w, z the share (Singer 1990, eq. 7)

    V(w, z) = exp(-z w t_n) |sum A_i exp((z + j sqrt(1 - z^2)) w t_i)|

The excitation's acceleration grows with the frequency, so the spectrum S is divided by f. What stays below 1/20 of its
peak does not count: vibration left = sum max(V S - s, 0) / sum max(S - s, 0), s = max(S)/20, for the worst of three
damping ratios, as a frame's is known badly.

Smoothing is how far (mm) a shaped path leaves the planned one at 5000 mm/s^2, the larger of two: by straight
acceleration, a/2 sum A_i (t_i - t)^2, and at a right-angled corner that is entered with the corner speed v,
sqrt(2) sum over t_i > t of A_i (v + a/2 (t_i - t)) (t_i - t), t being the mean time.

Of each type the frequency that leaves the minimum, and of frequencies that leave 0.1 % more the highest (the shortest
shaper); of the types the one with the lowest smoothing * (vibration left + 2 %).

Beside this the resonance itself: frequency and damping of |(1 + 2 z r j)/(1 - r^2 + 2 z r j)|^2, r = f/f0, which is
nearest to S/f (the excitation's S grows with f^2) by logarithm around its peak.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .fit_spectrum import Array, DataError, Spectrum, read_spectrum, write_spectrum
from .shapers import Shaper, parse

DAMPING_RATIO = 0.1
TEST_DAMPING_RATIOS = (0.075, 0.1, 0.15)
MIN_HZ, MAX_HZ, STEP_HZ = 5.0, 150.0, 0.2
THRESHOLD = 1.0 / 20.0
TIE = 0.001
VIBRATION_WEIGHT = 0.02
ACCEL_MM_S2 = 5000.0
SMOOTHING_MM = 0.12  # of the advised acceleration
CORNER_SPEED_MM_S = 5.0
AUTOTUNED = ("zv", "mzv", "ei", "2hump_ei", "3hump_ei")


@dataclass(frozen=True)
class Choice:
    """A shaper at its best frequency. `vibration`: share left."""

    shaper: str
    frequency_hz: float
    vibration: float
    smoothing_mm: float
    max_accel_mm_s2: float


def vibration_left(
    shaper: Shaper, shaper_hz: Array, frequency_hz: Array, damping_ratio: float, design: float
) -> Array:
    """V for each shaper frequency (rows) and each frequency of the frame (columns)."""
    amplitudes, times = (np.array(x) for x in shaper.pulses(1.0, design))
    w = 2.0 * np.pi * frequency_hz[None, :] / shaper_hz[:, None]
    pole = damping_ratio + 1j * np.sqrt(1.0 - damping_ratio**2)
    total = sum(a * np.exp(pole * w * (t - times[-1])) for a, t in zip(amplitudes, times, strict=True))
    return np.asarray(np.abs(total))


def smoothing(shaper: Shaper, shaper_hz: float, accel: float, corner_speed: float, design: float) -> float:
    """mm; see above."""
    amplitudes, times = (np.array(x) for x in shaper.pulses(shaper_hz, design))
    late = times - (amplitudes * times).sum()
    straight = 0.5 * accel * (amplitudes * late**2).sum()
    after = late > 0.0
    corner = (amplitudes * (corner_speed + 0.5 * accel * late) * late)[after].sum()
    return float(max(straight, np.sqrt(2.0) * corner))


def _greatest_accel(of_accel: Callable[[float], float]) -> float:
    """The acceleration whose smoothing is SMOOTHING_MM, mm/s^2; 0 if the corner alone is smoothed more."""
    low, high = 0.0, 1e6
    if of_accel(low) > SMOOTHING_MM:
        return 0.0
    while high - low > 1.0:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if of_accel(middle) <= SMOOTHING_MM else (low, middle)
    return low


def excited(spectrum: Spectrum) -> tuple[Array, Array]:
    """Frequencies and weights S: the sum of the axes over the frequency."""
    kept = (spectrum.frequency_hz >= MIN_HZ) & (spectrum.frequency_hz <= MAX_HZ)
    frequency = spectrum.frequency_hz[kept]
    return frequency, spectrum.psd[3][kept] / frequency


def fit_type(
    shaper: Shaper, spectrum: Spectrum, max_smoothing: float | None, corner_speed: float, design: float
) -> Choice | None:
    """The best of one type; None if none keeps to the smoothing."""
    frequency, weight = excited(spectrum)
    candidates = np.arange(shaper.kind.min_hz, MAX_HZ, STEP_HZ)
    floor = weight.max() * THRESHOLD
    whole = np.maximum(weight - floor, 0.0).sum()
    left = np.max(
        [
            np.maximum(vibration_left(shaper, candidates, frequency, z, design) * weight - floor, 0.0).sum(
                axis=1
            )
            for z in TEST_DAMPING_RATIOS
        ],
        axis=0,
    )
    left = left / whole
    smooth = np.array([smoothing(shaper, hz, ACCEL_MM_S2, corner_speed, design) for hz in candidates])
    allowed = smooth <= (np.inf if max_smoothing is None else max_smoothing)
    if not allowed.any():
        return None
    best = np.flatnonzero(allowed & (left <= left[allowed].min() + TIE))[-1]
    hz = float(candidates[best])
    accel = _greatest_accel(lambda a: smoothing(shaper, hz, a, corner_speed, design))
    return Choice(shaper.text, round(hz, 1), float(left[best]), float(smooth[best]), accel)


def recommend(choices: Sequence[Choice]) -> Choice:
    return min(choices, key=lambda c: c.smoothing_mm * (c.vibration + VIBRATION_WEIGHT))


def find_resonance(spectrum: Spectrum, axis: int) -> tuple[float, float]:
    """(Hz, damping ratio) of the highest peak of S/f; `axis`: row of the spectrum."""
    kept = (spectrum.frequency_hz >= 2.0 * MIN_HZ) & (spectrum.frequency_hz <= MAX_HZ)
    frequency = spectrum.frequency_hz[kept]
    weight = spectrum.psd[axis][kept] / frequency**2
    peak = frequency[np.argmax(weight)]
    near = (frequency > 0.75 * peak) & (frequency < 1.3 * peak)
    wanted, f = np.log(weight[near]), frequency[near]
    hz = peak * np.linspace(0.9, 1.1, 401)[:, None, None]
    z = np.geomspace(0.005, 0.4, 80)[None, :, None]
    r = f[None, None, :] / hz
    model = np.log((1.0 + (2.0 * z * r) ** 2) / ((1.0 - r * r) ** 2 + (2.0 * z * r) ** 2))
    rest = wanted - model
    rest = ((rest - rest.mean(axis=2, keepdims=True)) ** 2).sum(axis=2)
    i, j = np.unravel_index(np.argmin(rest), rest.shape)
    return float(hz[i, 0, 0]), float(z[0, j, 0])


def calibrate(
    spectrum: Spectrum,
    axis: int = 3,
    max_smoothing: float | None = None,
    corner_speed: float = CORNER_SPEED_MM_S,
    types: Sequence[str] = AUTOTUNED,
    damping_ratio: float = DAMPING_RATIO,
) -> tuple[dict[str, Any], Spectrum]:
    """What to report, and the spectrum with what each shaper leaves. Raises DataError."""
    found = [
        c
        for text in types
        if (c := fit_type(parse(text), spectrum, max_smoothing, corner_speed, damping_ratio))
    ]
    if not found:
        raise DataError(f"No shaper keeps the smoothing to {max_smoothing} mm. Allow more.")
    left = {
        f"{c.shaper}({c.frequency_hz:.1f})": vibration_left(
            parse(c.shaper), np.array([c.frequency_hz]), spectrum.frequency_hz, DAMPING_RATIO, damping_ratio
        )[0]
        for c in found
    }
    hz, z = find_resonance(spectrum, axis)
    report = {
        "shapers": [asdict(c) for c in found],
        "best": asdict(recommend(found)),
        "resonance_hz": hz,
        "damping_ratio": z,
    }
    return report, replace(spectrum, shapers=left)


def main(arguments: Sequence[str]) -> int:
    """Files to a spectrum (--out); with --axis also to a shaper."""
    parser = argparse.ArgumentParser(prog="fit_shaper")
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--axis", type=int, help="0, 1, 2 for x, y, z; 3: all")
    parser.add_argument("--max-smoothing", type=float)
    parser.add_argument("--corner-speed", type=float, default=CORNER_SPEED_MM_S)
    parser.add_argument("--damping-ratio", type=float, default=DAMPING_RATIO)
    args = parser.parse_args(arguments)
    report: dict[str, Any] = {}
    try:
        spectrum = read_spectrum(args.files)
        if args.axis is not None:
            report, spectrum = calibrate(
                spectrum, args.axis, args.max_smoothing, args.corner_speed, damping_ratio=args.damping_ratio
            )
        if args.out is not None:
            write_spectrum(args.out, spectrum)
    except (DataError, OSError) as e:
        print(e, file=sys.stderr)
        return 1
    print(json.dumps(report))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
