"""Entry points of an installed Ferrite (`pip install .`): ferrite-klippy, ferrite-simulate and others.

The modules in klippy/ import each other by bare names, as plugins do; so the installed tree has the same shape as a
checkout, and starting a program means putting its folders first on the path.
"""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def _start(module: str) -> int:
    if not (ROOT / ".venv").exists():  # the Makefile that builds the simulator needs a Python: this one
        os.environ.setdefault("MAKEFLAGS", f"PYTHON={sys.executable}")
    for folder in ("scripts", "klippy"):
        sys.path.insert(0, str(ROOT / folder))
    try:
        return int(importlib.import_module(module).main(sys.argv[1:]) or 0)
    except KeyboardInterrupt:
        print(f"{Path(sys.argv[0]).stem}: interrupted", file=sys.stderr)
        return 130  # as shells have it


def klippy() -> int:
    """The host."""
    return _start("klippy")


def simulate() -> int:
    """A print on the simulated printer."""
    return _start("simulate")


def study() -> int:
    """Many simulated prints."""
    return _start("study")


def console() -> int:
    """The MCU console."""
    return _start("console")


def printer() -> int:
    """The simulated printer in real time, with Moonraker."""
    return _start("run_printer")
