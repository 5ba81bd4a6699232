#!/usr/bin/env python3
"""The menu of `make menuconfig`: kconfiglib's, with a plain answer where there is no terminal to draw it on."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))

import in_venv

import argparse
import curses
import os
import runpy
from collections.abc import Sequence

BAD_USE = 2


def missing() -> str:
    """What the menu needs and does not find here."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return "standard input and output must be a terminal"
    try:
        curses.setupterm()
    except curses.error:
        return f"TERM is '{os.environ.get('TERM', '')}', which names no terminal known here (try TERM=xterm)"
    return ""


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description="Choose a chip and its options in a menu.")
    parser.add_argument("kconfig", help="file with the options there are")
    parser.parse_args(argv)
    problem = missing()
    if problem:
        print(
            f"menuconfig: {problem}; without the menu, `make PORT=NAME` builds for a chip with its usual options",
            file=sys.stderr,
        )
        return BAD_USE
    runpy.run_module("menuconfig", run_name="__main__", alter_sys=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
