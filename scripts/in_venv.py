"""Imported first by the programs here: `scripts/NAME.py` runs with the packages of .venv, be it activated or not.

Whoever starts them in an environment of his own keeps that one. Nothing in it is used (F401), and it has to come before
what needs those packages (isort).
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import TracebackType

PYTHON = Path(__file__).resolve().parent.parent / ".venv" / "bin" / "python"
INTERRUPTED = 130  # exit status, as shells have it


def _explain(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """A printer's own environment has less than these programs need, and an old one less than a new version. Whoever
    presses Ctrl-C knows why the program ends."""
    if isinstance(error, ModuleNotFoundError):
        text = f"{sys.argv[0]}: Python package '{error.name}' is missing; `make setup` installs it into .venv"
        print(text, file=sys.stderr)
        sys.exit(2)
    if isinstance(error, KeyboardInterrupt):
        print(f"{Path(sys.argv[0]).stem}: interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    sys.__excepthook__(kind, error, trace)


def _enter() -> None:
    # not an installed command, not a test that imports a program
    if Path(__file__).resolve().parent not in Path(sys.argv[0]).resolve().parents:
        return
    if sys.prefix == sys.base_prefix and PYTHON.exists() and Path(sys.executable) != PYTHON:
        os.execv(PYTHON, [str(PYTHON), *sys.orig_argv[1:]])
    sys.excepthook = _explain


_enter()
