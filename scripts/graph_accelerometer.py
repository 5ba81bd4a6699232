#!/usr/bin/env python3
"""Pictures of accelerometer data (CSV of ACCELEROMETER_MEASURE and TEST_RESONANCES).

scripts/graph_accelerometer.py /tmp/raw_data_x_*.csv -o /tmp/spectrum.png         power density of each axis
scripts/graph_accelerometer.py /tmp/adxl345-*.csv -r -o /tmp/raw.png              acceleration over time
scripts/graph_accelerometer.py /tmp/a.csv /tmp/b.csv -c -o /tmp/both.png          files side by side
"""

from __future__ import annotations

import in_venv

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "klippy"))

from vibration.fit_spectrum import COLUMNS, DataError, Spectrum, read, read_spectrum, write_spectrum

ROWS = {"x": 0, "y": 1, "z": 2, "all": 3}


def plot(args: argparse.Namespace) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(9, 5))
    for path in args.files:
        if args.raw:
            rows = read(path)
            if isinstance(rows, Spectrum):
                raise DataError(f"{path} has resonances; -r needs raw data.")
            for axis, letter in enumerate("xyz", 1):
                axes.plot(
                    rows[:, 0] - rows[0, 0], rows[:, axis], label=f"{path.stem} {letter}", linewidth=0.7
                )
            continue
        spectrum = read_spectrum([path])
        wanted = [ROWS[args.axis]] if args.compare or args.axis != "all" else range(len(COLUMNS))
        for row in wanted:
            axes.plot(
                spectrum.frequency_hz, spectrum.psd[row], label=f"{path.stem} {COLUMNS[row]}", linewidth=1.0
            )
    if args.raw:
        axes.set(xlabel="time, s", ylabel="acceleration, mm/s²")
    else:
        axes.set(xlim=(0, args.max_freq), xlabel="frequency, Hz", ylabel="power density, (mm/s²)²/Hz")
    axes.legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(args.output)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="picture, or .csv: the mean spectrum"
    )
    parser.add_argument("-f", "--max_freq", type=float, default=200.0, help="Hz")
    parser.add_argument("-r", "--raw", action="store_true", help="acceleration over time")
    parser.add_argument("-c", "--compare", action="store_true", help="one line for each file")
    parser.add_argument("-a", "--axis", choices=ROWS, default="all")
    args = parser.parse_args()
    try:
        if args.output.suffix == ".csv":
            write_spectrum(args.output, read_spectrum(args.files))
        else:
            plot(args)
    except (DataError, OSError) as e:
        print(e, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
