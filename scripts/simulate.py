#!/usr/bin/env python3
"""Prints a G-code file on the simulated printer: the whole stack in closed loop, faster than real time.

    scripts/simulate.py config/sim-induction.cfg part.gcode --trace trace.csv --summary summary.json

Exit status: 0 printed (or stopped by --until), 2 bad input, 3 the printer shut down (the reason is on stderr
and in the summary), 130 interrupted.
"""

from __future__ import annotations

import in_venv

import argparse
import json
import logging
import shlex
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from rich import progress as rich_progress
from rich.console import Console

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "klippy"))

import configtext  # noqa: E402  (the path above comes first)
import queuelogger  # noqa: E402
from simulation import faults  # noqa: E402
from simulation.runner import BAD_INPUT, Outcome, Progress, RunOptions, Simulation  # noqa: E402
from simulation.world import WorldError  # noqa: E402


class BadInput(Exception):
    """The command line asks for something that cannot be; the text is for people."""


def parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Print a G-code file on the simulated printer.",
        epilog="Exit status: 0 printed, 2 bad input, 3 the printer shut down, 130 interrupted.",
    )
    parser.add_argument("config", type=Path, help="printer.cfg with simulator sections")
    parser.add_argument("gcode", type=Path, help="file to print")
    parser.add_argument(
        "--trace", type=Path, metavar="FILE.csv", help="temperature, power, flow and position over time"
    )
    parser.add_argument("--summary", type=Path, metavar="FILE.json", help="figures of the run")
    parser.add_argument(
        "--report", type=Path, metavar="FILE.html", help="page with charts; a FILE.png goes beside it"
    )
    parser.add_argument("--seed", type=int, default=1, help="fixes noise and line damage (default 1)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.OPTION=VALUE",
        dest="overrides",
        help="override an option of the config, printer or plant alike; may be repeated",
    )
    parser.add_argument(
        "--build",
        action="append",
        default=[],
        metavar="[MCU=]BUILD",
        dest="builds",
        help="what an MCU runs: simulator, or the image for a chip on its emulator: stm32f334, atmega2560",
    )
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="NAME[:ARG]@T",
        dest="faults",
        help="break something after T simulated seconds (docs/reference/Simulation.md); may be repeated",
    )
    parser.add_argument("--until", type=float, metavar="SECONDS", help="stop after so much simulated time")
    parser.add_argument("--log", type=Path, metavar="FILE", help="the host's log")
    parser.add_argument("--api", type=Path, metavar="SOCKET", help="serve the API on this unix socket")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser.parse_args(argv)


def parse_override(text: str) -> tuple[str, str, str]:
    """'simulator load bed.fan_w_k=0.2' → (section, option, value), split at the last dot before '='."""
    name, equals, value = text.partition("=")
    section, dot, option = name.rpartition(".")
    if not equals or not dot or not section.strip() or not option.strip():
        raise BadInput(
            f"--set {text}: this needs the form SECTION.OPTION=VALUE, such as extruder.nozzle_diameter=0.6"
        )
    return section.strip(), option.strip(), value.strip()


def parse_builds(texts: Sequence[str]) -> dict[str, str]:
    """'stm32f334' and 'heater=stm32f334' → build by MCU."""
    builds = {}
    for text in texts:
        name, equals, build = text.partition("=")
        builds[name if equals else "mcu"] = build if equals else text
    return builds


def check_overrides(config: Path, overrides: Sequence[tuple[str, str, str]]) -> None:
    """A section that the config does not have cannot be overridden: it is probably misspelt."""
    data = configtext.ConfigData()
    try:
        text = configtext.split_autosave(configtext.read_text(str(config)))[0]
        configtext.ConfigParser(data).parse_text(text, str(config))
    except configtext.ConfigError as e:
        raise BadInput(str(e)) from None
    for section, option, _ in overrides:
        if section not in data.sections:
            raise BadInput(f"--set {section}.{option}: the config {config} has no section [{section}].")


def check_files(options: argparse.Namespace) -> None:
    for what, path in (("config", options.config), ("G-code file", options.gcode)):
        if not path.is_file():
            raise BadInput(f"There is no {what} {path}.")
    for path in (options.trace, options.summary, options.report, options.log, options.api):
        if path is not None and not path.resolve().parent.is_dir():
            raise BadInput(f"Cannot write {path}: the folder {path.parent} does not exist.")
    if options.report is not None and options.trace is None:
        options.trace = options.report.with_suffix(".csv")


class Bar(AbstractContextManager["Bar"]):
    """Progress by file position, with simulated time and the ratio to real time."""

    def __init__(self, name: str) -> None:
        self._progress = rich_progress.Progress(
            rich_progress.TextColumn("{task.description}"),
            rich_progress.BarColumn(bar_width=None),
            rich_progress.TextColumn(
                "{task.percentage:5.1f} %  {task.fields[clock]}  {task.fields[ratio]} × real time"
            ),
            console=Console(stderr=True),
        )
        self._task = self._progress.add_task(name, total=1.0, clock="0 s", ratio="-")

    def __enter__(self) -> Bar:
        self._progress.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._progress.stop()

    def show(self, now: Progress) -> None:
        minutes, seconds = divmod(int(now.simulated_s), 60)
        ratio = f"{now.simulated_s / now.wall_s:.0f}" if now.wall_s > 0 else "-"
        self._progress.update(
            self._task, completed=now.fraction, clock=f"{minutes}:{seconds:02d}", ratio=ratio
        )


def write_results(options: argparse.Namespace, outcome: Outcome) -> None:
    if options.summary is not None:
        options.summary.write_text(json.dumps(outcome.summary, indent=2) + "\n", encoding="utf-8")
    if options.report is None or "axes" not in outcome.summary:
        return
    from simulation.report import ReportError, write_report

    try:
        write_report(
            options.trace,
            outcome.summary,
            options.gcode,
            html=options.report,
            png=options.report.with_suffix(".png"),
        )
    except ReportError as e:
        print(f"simulate: no report: {e}", file=sys.stderr)


def print_outcome(outcome: Outcome) -> None:
    """One line of what happened: stdout if it went well, else stderr."""
    facts: dict[str, Any] = outcome.summary
    unknown = facts.get("unknown_commands")
    if unknown:
        names = ", ".join(f"{name} ({count} ×)" for name, count in sorted(unknown.items()))
        print(f"simulate: commands this printer does not know, passed over: {names}", file=sys.stderr)
    if outcome.status != 0:
        print(f"simulate: {facts['status']}: {outcome.reason}", file=sys.stderr)
        return
    print(
        f"{outcome.reason}: {facts['simulated_s']:.1f} s simulated in {facts['wall_s']:.1f} s "
        f"({facts['ratio']:.0f} × real time), {facts['moves']} moves"
    )


def set_up_log(path: Path | None) -> None:
    """As the host's own log, which scripts/log_extract.py reads."""
    handler: logging.Handler = logging.NullHandler() if path is None else logging.FileHandler(path, mode="w")
    handler.setFormatter(queuelogger.LineFormatter("%(message)s"))
    logging.basicConfig(level=logging.INFO if path else logging.CRITICAL + 1, handlers=[handler])


def main(argv: Sequence[str]) -> int:
    options = parse(argv)
    try:
        check_files(options)
        overrides = tuple(parse_override(text) for text in options.overrides)
        check_overrides(options.config, overrides)
        for text in options.faults:
            faults.parse(text)
        set_up_log(options.log)
        bar = None if options.quiet or not sys.stderr.isatty() else Bar(options.gcode.name)
        with bar or nullcontext():
            outcome = Simulation(
                RunOptions(
                    options.config,
                    options.gcode,
                    options.seed,
                    overrides,
                    options.trace,
                    options.until,
                    bar.show if bar else None,
                    parse_builds(options.builds),
                    options.log,
                    tuple(options.faults),
                    api=options.api,
                )
            ).run()
        outcome.summary["command"] = shlex.join(
            ["scripts/simulate.py", *(text.replace(f"{ROOT}/", "") for text in argv)]
        )
        write_results(options, outcome)
    except (BadInput, faults.FaultError, WorldError, OSError) as e:
        print(f"simulate: {e}", file=sys.stderr)
        return BAD_INPUT
    print_outcome(outcome)
    return outcome.status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
