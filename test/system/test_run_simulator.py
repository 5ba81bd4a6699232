"""The simulated printer in real time behind pseudo terminals, as an outside host sees it."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from system.conftest import CONFIG, ROOT, TWO_MCUS

IDENTIFY = bytes.fromhex("08100100285e9f7e")  # identify offset=0 count=40, sequence 0
ACK = bytes.fromhex("05118f087e")


def start(config: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, str(ROOT / "scripts" / "run_simulator.py"), str(config), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "tty"
    process = start(CONFIG, "--pty", str(path), "--until", "20")
    assert process.stdout is not None
    assert str(path) in process.stdout.readline()
    yield path
    process.terminate()
    process.wait(10)


def exchange(path: Path, data: bytes, wanted: bytes) -> tuple[bytes, float]:
    """Send, and read until `wanted` has come or 2 s have passed; (bytes, seconds)."""
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        begin = time.monotonic()
        os.write(fd, data)
        answer = b""
        while wanted not in answer and time.monotonic() < begin + 2.0:
            if select.select([fd], [], [], 0.1)[0]:
                answer += os.read(fd, 4096)
        return answer, time.monotonic() - begin
    finally:
        os.close(fd)


def test_an_mcu_answers_identify(terminal: Path) -> None:
    answer, seconds = exchange(terminal, IDENTIFY, ACK)
    start = answer.index(bytes.fromhex("3011"))  # `starting` and `stats` may come first
    assert answer[start + 2 : start + 5] == bytes.fromhex("000028")
    assert ACK in answer
    # 8 bytes there and 53 back at 250 kBd are 2.4 ms; a busy computer adds its delays
    assert seconds < 0.5


def test_each_mcu_has_its_own_terminal_and_bad_ones_are_refused(tmp_path: Path) -> None:
    process = start(TWO_MCUS, f"--pty={tmp_path}/a", f"--pty=heater={tmp_path}/b", "--until", "0.2")
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert f"{tmp_path}/a" in out
    assert f"{tmp_path}/b" in out
    assert not (tmp_path / "a").is_symlink(), "terminals go when the simulator ends"

    process = start(CONFIG, f"--pty=nobody={tmp_path}/c")
    _, err = process.communicate(timeout=30)
    assert process.returncode == 2
    assert "nobody" in err
    assert "Traceback" not in err


def test_a_file_in_the_way_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "tty").write_text("precious")
    process = start(CONFIG, f"--pty={tmp_path}/tty")
    _, err = process.communicate(timeout=30)
    assert process.returncode == 2
    assert (tmp_path / "tty").read_text() == "precious"
    assert str(tmp_path / "tty") in err
