"""The files on which the heater's safety rests, the tests written for them, and copies of the tree to try things in.

Two programs use the table: safety_coverage.py (do the tests reach every line and branch?) and mutants.py (do they
notice when something is changed there?).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GCC = shutil.which("gcc") or "gcc"


@dataclass(frozen=True)
class Part:
    """A file, or some functions of a C file, and the tests written for it."""

    source: str
    tests: tuple[str, ...]
    functions: tuple[str, ...] = ()

    @property
    def is_c(self) -> bool:
        return self.source.endswith(".c")


_SUPERVISION_TESTS = (
    "test/unit/thermal/test_thermal_supervise.py",
    "test/unit/thermal/test_supervision_witness.py",
)
SAFETY: dict[str, tuple[Part, ...]] = {
    "guard": (Part("src/guard.c", ("test/c/test_induction_guard.py",)),),
    "signal_test": (Part("src/signal_test.c", ("test/c/test_signal_test.py",)),),
    "oversample": (Part("src/oversample.c", ("test/c/test_induction_oversample.py",)),),
    "phase": (Part("src/phase.c", ("test/c/test_induction_phase.py",)),),
    "wire": (Part("src/wire.c", ("test/c/test_wire.py",)),),
    "timed_output": (Part("src/timed_output.c", ("test/c/test_mcu_outputs.py",)),),
    "supervision": (
        Part("klippy/thermal/sensing/supervision.py", _SUPERVISION_TESTS),
        Part("klippy/thermal/sensing/pipeline.c", _SUPERVISION_TESTS, ("chain_watch_block",)),
    ),
}


def copy_tree(folder: Path) -> Path:
    """What git would commit of this checkout, in `folder`, with the Python environment of this one."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout.decode()
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    (folder / ".venv").symlink_to(ROOT / ".venv")
    return folder


def with_gcc_flags(folder: Path, *flags: str) -> dict[str, str]:
    """An environment in which whatever calls gcc calls it with `flags` at the end. `folder`: where its gcc is put."""
    folder.mkdir()
    for name in ("gcc", "cc"):
        (folder / name).write_text(f'#!/bin/sh\nexec "{GCC}" "$@" {" ".join(flags)}\n')
        (folder / name).chmod(0o755)
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PYTEST_", "FERRITE_"))}
    return {**kept, "PATH": f"{folder}:{os.environ['PATH']}", "FERRITE_VERSION": "v0-check"}


def pytest_command(tests: tuple[str, ...], *program: str) -> list[str]:
    """The tests one after the other up to the first failure, the same ones each time; `program` in place of pytest."""
    return [sys.executable, *(program or ("-m", "pytest")), "-qx", "--hypothesis-seed=0", *tests]
