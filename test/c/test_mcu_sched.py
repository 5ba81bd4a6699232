"""The scheduler where interrupts really come in the middle of tasks (mcu_sched_check.c plays the interrupt)."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from mcu_harness import ROOT, Dictionary

REASONS = {text: number for number, text in Dictionary.built().shutdown_texts.items()}


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sched") / "check"
    sources = [ROOT / "test" / "c" / "mcu_sched_check.c", ROOT / "src" / "sched.c"]
    flags = ["-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined"]
    includes = [f"-I{ROOT}/src", f"-I{ROOT}/src/simulator"]
    subprocess.run(["gcc", *flags, *includes, "-o", path, *sources], check=True)
    return path


@pytest.mark.parametrize(
    ("scenario", "events", "reason"),
    [
        # the interrupt makes safe at once; the task ends its work; then outputs are made safe once more
        ("nested", "respond2 timer safe task-goes-on safe respond3", "ADC out of range"),
        ("failing-task", "respond2 safe respond3", "Command request"),
        ("init-fails", "safe respond2 respond3", "Not an output pin"),
        ("order", "respond2 tick150 tick200 next300 tick300 tick300", None),
    ],
)
def test_order_of_events(program: Path, scenario: str, events: str, reason: str | None) -> None:
    run = subprocess.run([program, scenario], capture_output=True, text=True, check=True)
    number = REASONS[reason] if reason else 0
    assert run.stdout.split() == [*events.split(), "output0", f"reason{number}"]
