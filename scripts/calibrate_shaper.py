#!/usr/bin/env python3
"""Input shapers for measured vibrations: raw accelerometer data or resonances as CSV, of TEST_RESONANCES.

scripts/calibrate_shaper.py /tmp/resonances_x_*.csv -o /tmp/shaper_x.png
"""

from __future__ import annotations

import in_venv

import argparse
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "klippy"))

from vibration.fit_shaper import AUTOTUNED, CORNER_SPEED_MM_S, DAMPING_RATIO, calibrate
from vibration.fit_spectrum import COLUMNS, DataError, Spectrum, read_spectrum, write_spectrum
from vibration.shapers import parse


def plot(report: dict[str, Any], spectrum: Spectrum, path: Path, max_hz: float) -> None:
    """Power densities, and what each shaper leaves."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(9, 5))
    for name, row in zip(COLUMNS, spectrum.psd, strict=True):
        axes.plot(spectrum.frequency_hz, row, label=name, linewidth=1.8 if name == "psd_xyz" else 0.8)
    axes.set(xlim=(0, max_hz), xlabel="frequency, Hz", ylabel="power density, (mm/s²)²/Hz")
    right = axes.twinx()
    best = report["best"]["shaper"]
    for name, left in spectrum.shapers.items():
        is_best = name.startswith(f"{best}(")
        right.plot(spectrum.frequency_hz, left, "--", linewidth=1.6 if is_best else 0.8, label=name)
    right.set(ylim=(0, 1), ylabel="vibration left, share")
    axes.legend(loc="upper left", fontsize="small")
    right.legend(loc="upper right", fontsize="small")
    figure.tight_layout()
    figure.savefig(path)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, help="picture")
    parser.add_argument("-c", "--csv", type=Path, help="resonances with what each shaper leaves")
    parser.add_argument("-f", "--max_freq", type=float, default=200.0, help="of the picture, Hz")
    parser.add_argument("-s", "--max_smoothing", type=float, help="mm at 5000 mm/s^2")
    parser.add_argument("--scv", type=float, default=CORNER_SPEED_MM_S, help="square corner velocity, mm/s")
    parser.add_argument("--shapers", default=",".join(AUTOTUNED), help="types to try")
    parser.add_argument(
        "--damping_ratio", type=float, default=DAMPING_RATIO, help="that the shapers are made for"
    )
    args = parser.parse_args()
    try:
        types = [parse(text).text for text in args.shapers.split(",")]
        report, spectrum = calibrate(
            read_spectrum(args.files), 3, args.max_smoothing, args.scv, types, args.damping_ratio
        )
        if args.csv is not None:
            write_spectrum(args.csv, spectrum)
        if args.output is not None:
            plot(report, spectrum, args.output, args.max_freq)
    except (DataError, OSError, ValueError) as e:
        print(e, file=sys.stderr)
        return 1
    print(f"Resonance: {report['resonance_hz']:.1f} Hz, damping ratio {report['damping_ratio']:.3f}")
    for c in report["shapers"]:
        print(
            f"Fitted shaper '{c['shaper']}' frequency = {c['frequency_hz']:.1f} Hz (vibrations ="
            f" {100 * c['vibration']:.1f}%, smoothing ~= {c['smoothing_mm']:.3f}, max_accel <="
            f" {c['max_accel_mm_s2']:.0f} mm/s^2)"
        )
    print(f"Recommended shaper is {report['best']['shaper']} @ {report['best']['frequency_hz']:.1f} Hz")
    return 0


if __name__ == "__main__":
    sys.exit(main())
