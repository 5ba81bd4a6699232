#!/usr/bin/env python3
"""A picture of what [nozzle_monitor] saw, from the table of NOZZLE_REPORT PLOT=1.

    scripts/bench/plot_nozzle.py /tmp/nozzle_report_NAME.csv > report.png

Above the diameter with twice its standard deviation, below the evidence of a change and the lost flow. Times in which
the nozzle is not clear are coloured. It needs matplotlib.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from pathlib import Path
from typing import BinaryIO

COLOURS = {"restricted": "orange", "clogged": "red", "no_filament": "purple"}
Row = dict[str, str]


def number(row: Row, name: str) -> float:
    return float(row[name]) if row[name] else math.nan


def plot(rows: list[Row], output: BinaryIO) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (upper, lower) = pyplot.subplots(2, 1, sharex=True, figsize=(9, 6))
    minutes = [(number(row, "t_s") - number(rows[-1], "t_s")) / 60.0 for row in rows]
    diameter, sigma = ([number(row, name) for row in rows] for name in ("diameter_mm", "sigma_mm"))
    upper.plot(minutes, diameter, color="tab:blue")
    low, high = ([d + sign * 2.0 * s for d, s in zip(diameter, sigma, strict=True)] for sign in (-1.0, 1.0))
    upper.fill_between(minutes, low, high, color="tab:blue", alpha=0.25, linewidth=0)
    upper.set(ylabel="diameter, mm (± 2 sigma)", title=f"Nozzle: {rows[-1]['condition']}")
    for name, label in (("evidence", "evidence of a change (1: alarm)"), ("lost_flow", "lost flow")):
        lower.plot(minutes, [number(row, name) for row in rows], label=label)
    lower.set(xlabel="minutes", ylim=(0.0, 1.05))
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
        for at, row in enumerate(rows[:-1]):
            if row["condition"] in COLOURS:
                axes.axvspan(
                    minutes[at], minutes[at + 1], color=COLOURS[row["condition"]], alpha=0.2, linewidth=0
                )
    lower.legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(output, dpi=100, format="png")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("table", type=Path, metavar="REPORT.csv")
    with parser.parse_args().table.open() as stream:
        rows = list(csv.DictReader(stream))
    plot(rows, sys.stdout.buffer)
    return 0


if __name__ == "__main__":
    sys.exit(main())
