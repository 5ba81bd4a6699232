#!/usr/bin/env python3
"""Decide recorded runs again with this version, and show what moved.

    scripts/replay.py RUN.run [MORE.run ...] [--plot DIR] [--json FILE]

A run comes from INDUCTION_RECORD, from a fault (record_seconds) or from a simulated print (record_file). Filter,
control law and supervision run again on the recorded blocks, and so does the guard of the MCU.

Exit status: 0 the same bit for bit, 1 something moved, 2 a file is no recorded run.
"""

from __future__ import annotations

import in_venv

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "klippy"))

from simulation import replay
from thermal.recording import rerun
from thermal.recording.plain import UnknownType
from thermal.recording.stored import RunFileError

COLUMNS = (
    "run",
    "answers",
    "changed",
    "|dT| max C",
    "dT rms C",
    "|dP| max W",
    "fault recorded",
    "fault now",
    "guard",
)


def parse_arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Decide recorded runs again with this version, and show what moved.",
        epilog="Exit status: 0 the same bit for bit, 1 something moved, 2 a file is no recorded run.",
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN.run")
    parser.add_argument("--plot", type=Path, metavar="DIR", help="a picture of each run, both sides")
    parser.add_argument("--json", type=Path, metavar="FILE", help="figures of each run")
    return parser.parse_args(argv)


def row(name: str, run: rerun.Rerun, guard: replay.Guard) -> list[str]:
    found = run.figures()
    numbers = (f"{found['temp_max_c']:.3g}", f"{found['temp_rms_c']:.3g}", f"{found['power_max_w']:.3g}")
    faults = (text[:40] or "-" for text in run.fault)
    judged = guard.trip or (f"{guard.bad_blocks} bad blocks at the end" if guard.bad_blocks else "-")
    return [name, str(found["answers"]), str(found["changed"]), *numbers, *faults, judged]


def table(rows: list[list[str]]) -> str:
    lines = [list(COLUMNS), *rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(COLUMNS))]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)) for line in lines
    )


def draw(run: rerun.Rerun, path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    start_s = run.again[0].now_s if run.again else 0.0
    for side, label, style in ((run.recorded, "recorded", "C0-"), (run.again, "this version", "C1--")):
        times = [a.now_s - start_s for a in side]
        top.plot(times, [a.temp_c for a in side], style, lw=1.0, label=label)
        bottom.plot(times, [a.power_w for a in side], style, lw=0.8, label=label)
    top.set(ylabel="nozzle, °C", title=path.stem)
    bottom.set(ylabel="requested heat, W", xlabel="time, s")
    top.legend(loc="best")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def main(argv: list[str] | None = None) -> int:
    options = parse_arguments(argv)
    rows, figures, is_same = [], {}, True
    for path in options.runs:
        try:
            run, guard = replay.replayed(path)
        except (RunFileError, UnknownType, OSError) as e:
            print(f"replay: {path}: {e}", file=sys.stderr)
            return 2
        rows.append(row(path.stem, run, guard))
        is_same = is_same and run.is_same()
        found: dict[str, Any] = {**run.figures(), "fault": run.fault, "guard": guard.trip, "gaps": run.gaps}
        figures[path.stem] = found
        if options.plot is not None:
            draw(run, options.plot / f"{path.stem}.png")
    print(table(rows))
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    return 0 if is_same else 1


if __name__ == "__main__":
    sys.exit(main())
