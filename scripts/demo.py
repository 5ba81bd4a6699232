#!/usr/bin/env python3
"""Prints a part on the simulated induction printer and reports on it (`make demo`).

Slices the part (klippy/simulation/demo_part.py), runs scripts/simulate.py, then writes from its trace a page, a sheet
of charts and a picture of the part, and shows the figures.
"""

from __future__ import annotations

import in_venv

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "klippy"))

from simulation import demo_part  # noqa: E402  (the path above comes first)
from simulation.report import ReportError, write_report  # noqa: E402
from simulation.report.data import read_trace  # noqa: E402
from simulation.report.figures import Figure, PrintRun  # noqa: E402
from simulation.report.portrait import draw_portrait  # noqa: E402
from simulation.sample_gcode import SampleMissing, sample_path  # noqa: E402

INTERRUPT_WAIT_S = 5.0


def parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Print a part on the simulated induction printer.")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "out" / "demo", help="folder for what the print leaves"
    )
    parser.add_argument("--sample", help="print this sample file (cubhelix, benchy, ...), not the lighthouse")
    parser.add_argument("--config", type=Path, default=ROOT / "config" / "sim-real.cfg")
    return parser.parse_args(argv)


def simulate(config: Path, gcode: Path, out: Path) -> int:
    """Prints the file; leaves trace.csv and summary.json in `out`. Returns simulate.py's exit status."""
    command = [sys.executable, str(ROOT / "scripts" / "simulate.py"), str(config), str(gcode)]
    command += ["--trace", str(out / "trace.csv"), "--summary", str(out / "summary.json")]
    with subprocess.Popen(command) as program:
        try:
            return program.wait()
        except KeyboardInterrupt:  # the terminal has interrupted both, and the program says so
            try:
                return program.wait(INTERRUPT_WAIT_S)
            except subprocess.TimeoutExpired:
                program.terminate()
                raise


def part_of(options: argparse.Namespace) -> Path:
    """The file to print."""
    if options.sample:
        return sample_path(options.sample)
    path: Path = options.out / "lighthouse.gcode"
    path.write_text(demo_part.gcode(), encoding="utf-8")
    return path


def show(figures: Sequence[Figure]) -> None:
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(style="dim")
    for figure in figures:
        table.add_row(figure.label, figure.value, figure.note)
    Console().print(table)


def main(argv: Sequence[str]) -> int:
    options = parse(argv)
    out: Path = options.out
    try:
        out.mkdir(parents=True, exist_ok=True)
        gcode = part_of(options)
        status = simulate(options.config, gcode, out)
        if status != 0:
            return status
        figures = write_report(
            out / "trace.csv", out / "summary.json", gcode, html=out / "report.html", png=out / "report.png"
        )
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        picture = out / "part.png"
        draw_portrait(picture, gcode.stem.capitalize(), PrintRun.of(read_trace(out / "trace.csv"), summary))
    except (SampleMissing, ReportError) as e:
        print(f"demo: {e}", file=sys.stderr)
        return 2
    show(figures)
    print(
        f"\nThe part: {picture}. Open {out / 'report.html'} in a browser; {out / 'report.png'} has its charts."
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
