"""Imported first by the programs here: `scripts/NAME.py` runs with the packages of .venv, be it activated or not.

Whoever starts them in an environment of his own keeps that one. Nothing in it is used (F401), and it has to come before
what needs those packages (isort).
"""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

PYTHON = Path(__file__).resolve().parent.parent / ".venv" / "bin" / "python"


def _enter() -> None:
    # not an installed command, not a test that imports a program
    by_name = Path(sys.argv[0]).resolve().parent == Path(__file__).resolve().parent
    if not by_name or sys.prefix != sys.base_prefix:
        return
    if PYTHON.exists():
        os.execv(PYTHON, [str(PYTHON), *sys.orig_argv[1:]])
    if importlib.util.find_spec("cffi") is None:
        sys.exit(f"{sys.argv[0]}: Python packages are missing; `make setup` installs them into .venv")


_enter()
