#!/usr/bin/env python3
"""Runs a study: many simulated prints with varied parameters, in parallel, and one table of their figures.

    scripts/study.py config/studies/machines.toml --out out/machines

The same command continues a study that was stopped. docs/guides/Studies.md is the guide. Exit status: 0 all limits
met, 1 a limit is not met, 2 the study file is wrong or the study cannot go on, 130 interrupted.
"""

from __future__ import annotations

import in_venv

import argparse
import importlib.util
import signal
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from rich import progress as rich_progress
from rich.console import Console

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "klippy"))

from simulation.sample_gcode import sample_path  # noqa: E402
from simulation.study.studyfile import Study, StudyError, near, read_study  # noqa: E402  (the path comes first)

BAD_STUDY = 2
INTERRUPTED = 130
PACKAGES = ("distributed", "pyarrow")


def parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Run a study of simulated prints, or continue it.",
        epilog="Exit status: 0 limits met, 1 not met, 2 wrong study, 130 interrupted.",
    )
    parser.add_argument("study", type=Path, metavar="STUDY.toml")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the results")
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=int, metavar="N", help="prints at a time (default: one for each core)"
    )
    where.add_argument("--scheduler", metavar="ADDRESS", help="a dask scheduler, as tcp://host:8786")
    parser.add_argument(
        "--run", metavar="KEY", help="repeat one print, with trace, log and report in DIR/runs/KEY"
    )
    parser.add_argument("--small", action="store_true", help="the study's small form")
    parser.add_argument("--runs", type=int, metavar="N", help="points of the plan in place of the file's")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser.parse_args(argv)


class Bar(AbstractContextManager["Bar"]):
    """Finished prints and the time that is left."""

    def __init__(self, name: str) -> None:
        self._progress = rich_progress.Progress(
            rich_progress.TextColumn("{task.description}"),
            rich_progress.BarColumn(bar_width=None),
            rich_progress.MofNCompleteColumn(),
            rich_progress.TimeElapsedColumn(),
            rich_progress.TimeRemainingColumn(),
            console=Console(stderr=True),
        )
        self._task = self._progress.add_task(name, total=None)

    def __enter__(self) -> Bar:
        self._progress.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._progress.stop()

    def show(self, done: int, total: int) -> None:
        self._progress.update(self._task, completed=done, total=total)


def run(options: argparse.Namespace, study: Study) -> int:
    from simulation.study.prepare import prepare
    from simulation.study.results import command_of
    from simulation.study.run import repeat, run_study, summary_lines

    prepared = prepare(study, sample_path)
    if options.run:
        if options.run not in prepared.jobs:
            raise StudyError(
                f"--run {options.run}: the study has no such print.{near(options.run, prepared.jobs)}"
            )
        row = repeat(prepared, options.run, options.out)["row"]
        print(f"{row['status']}: {row['reason']}; see {options.out / 'runs' / options.run}")
        return 0
    size = ["--small"] * options.small + (["--runs", options.runs] if options.runs is not None else [])
    command = command_of("scripts/study.py", options.study, "--out", options.out, *size)
    bar = None if options.quiet or not sys.stderr.isatty() else Bar(options.study.name)
    with bar or nullcontext():
        finished = run_study(
            study,
            prepared,
            options.out,
            command,
            (options.scheduler, options.workers),
            bar.show if bar else lambda done, total: None,
        )
    print("\n".join(summary_lines(finished)))
    if finished.failed:
        print(f"{finished.failed} prints did not end well; {options.out / 'failures.txt'} repeats each.")
    print(f"{len(finished.rows)} prints, see {options.out / 'index.html'} and results.parquet there.")
    return finished.status


def interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


def main(argv: Sequence[str]) -> int:
    options = parse(argv)
    signal.signal(signal.SIGTERM, interrupt)  # workers and prints end in order, and the table is written
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        print(
            f"study: Python package {missing[0]} is missing; scripts/setup.sh study installs it",
            file=sys.stderr,
        )
        return BAD_STUDY
    try:
        return run(options, read_study(options.study, options.small, options.runs))
    except StudyError as e:
        print(f"study: {e}", file=sys.stderr)
        return BAD_STUDY
    except KeyboardInterrupt:
        print("study: interrupted; the same command continues", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
