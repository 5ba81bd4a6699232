#!/usr/bin/env python3
"""Names all problems of a printer.cfg at once, without a board.

    scripts/check_config.py printer.cfg
    scripts/check_config.py printer.cfg -d klipper.dict -d toolhead=ebb.dict

The sections are loaded as at a start of the printer, plugins included. Without the dictionary of a board its pins and
buses can not be checked, for each firmware has its own. Exit status: 0 the printer would start, 1 problems, 2 bad use.
"""

from __future__ import annotations

import in_venv

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "klippy"))

from printer import Printer
from reactor import Reactor
from simulation.path_host import NoWaiting


class BoardlessPrinter(Printer):
    """Boards with a made-up firmware that has every command and every pin."""

    CORE_FIRST = ("pins", "simulation.path_host")


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("config", type=Path, metavar="printer.cfg")
    parser.add_argument(
        "-d",
        "--dictionary",
        metavar="DICT|NAME=DICT",
        action="append",
        default=[],
        help="data dictionary of a board; NAME= for boards other than [mcu] (repeatable, for all boards or none)",
    )
    return parser.parse_args(argv)


def start_args(args: argparse.Namespace) -> dict[str, Any]:
    """As of a run whose messages go nowhere."""
    found: dict[str, Any] = {
        "config_file": str(args.config),
        "config_overrides": [],
        "debugoutput": os.devnull,
        "apiserver": None,
        "gcode_fd": None,
        "start_reason": "startup",
        "log_file": None,
        "software_version": "check",
        "cpu_info": "check",
    }
    for entry in args.dictionary:
        name, _, path = entry.rpartition("=")
        found["dictionary" + (f"_{name}" if name and name != "mcu" else "")] = path
    return found


def check(args: argparse.Namespace) -> tuple[bool, list[str]]:
    """(the printer would start, texts for the user)."""
    reactor = Reactor(NoWaiting())
    printer = (Printer if args.dictionary else BoardlessPrinter)(reactor, start_args(args))

    def wait_for_start(eventtime: float) -> None:
        while printer.get_state_message()[1] == "startup":
            reactor.pause(reactor.monotonic() + 0.1)
        printer.request_exit("exit")

    reactor.register_callback(wait_for_start)
    printer.run()
    message, state = printer.get_state_message()
    configfile = printer.lookup_object("configfile", None)
    warnings = configfile.get_status(0.0)["warnings"] if configfile is not None else []
    reactor.finalize()
    notes = [warning["message"] for warning in warnings]
    return state == "ready", notes if state == "ready" else [message.rpartition("\nOnce the")[0], *notes]


def main(argv: Sequence[str] | None = None) -> int:
    args = parse(argv)
    for path in (args.config, *(Path(entry.rpartition("=")[2]) for entry in args.dictionary)):
        if not path.is_file():
            print(f"check_config.py: there is no file {path}", file=sys.stderr)
            return 2
    logging.disable(logging.CRITICAL)
    starts, texts = check(args)
    for text in texts:
        print(text)
    print(f"{args.config}: {'the printer would start' if starts else 'the printer would not start'}")
    return 0 if starts else 1


if __name__ == "__main__":
    sys.exit(main())
