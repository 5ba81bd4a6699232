"""scripts/emulate.py: the image in real time behind a pseudo terminal, as an outside host sees it."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from simulation.builds import BUILDS, WorldError, make_build
from system.test_run_simulator import ACK, IDENTIFY, ROOT, exchange


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Path]:
    make_build("stm32f334")  # not while the clock runs
    path = tmp_path / "tty"
    command = [sys.executable, str(ROOT / "scripts" / "emulate.py"), "stm32f334", "--pty", str(path)]
    process = subprocess.Popen([*command, "--until", "20"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert str(path) in process.stdout.readline()
    yield path
    process.terminate()
    process.wait(10)


def test_the_chip_answers_identify(terminal: Path) -> None:
    exchange(
        terminal, b"", b"~"
    )  # it has started: what came before its serial port was up is lost, as on a board
    answer, _ = exchange(terminal, IDENTIFY, ACK)
    assert bytes.fromhex("000028") in answer and ACK in answer


def test_an_unknown_chip_is_refused(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "emulate.py"), "z80"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 2 and "stm32f334" in run.stderr


def test_a_print_names_a_build_that_is_not(tmp_path: Path) -> None:
    gcode = tmp_path / "part.gcode"
    gcode.write_text("G28\n")
    command = [str(ROOT / "scripts" / "simulate.py"), str(ROOT / "config" / "sim-f334.cfg"), str(gcode)]
    run = subprocess.run(
        [sys.executable, *command, "--build", "z80"], capture_output=True, text=True, check=False
    )
    assert run.returncode == 2 and "no build 'z80'" in run.stderr


def test_an_image_that_does_not_build_says_what_brings_its_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    failed = subprocess.CompletedProcess(
        [], 2, stdout="", stderr="fatal error: unicorn/unicorn.h: No such file"
    )
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: failed)
    make_build.cache_clear()
    with pytest.raises(
        WorldError, match=r"does not build \(`make setup-test` brings(?s:.*)unicorn/unicorn.h"
    ):
        make_build("stm32f334")


@pytest.mark.parametrize("chip", [build.name for build in BUILDS.values() if build.emulated])
def test_the_closing_line_counts_seconds_of_that_chips_clock(chip: str, tmp_path: Path) -> None:
    """The Mega's clock has 16 MHz: by the other chip's 72 its second would be 0.2."""
    make_build(chip)
    command = [sys.executable, str(ROOT / "scripts" / "emulate.py"), chip, "--pty", str(tmp_path / "tty")]
    run = subprocess.run([*command, "--until", "1"], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    seconds = re.search(r"emulate: ([0-9.]+) s, ([0-9.]+) million instructions", run.stdout.splitlines()[-1])
    assert seconds is not None and 0.9 <= float(seconds[1]) <= 1.2
